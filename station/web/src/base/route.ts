// The views and their addresses. They are behind the #, so that a static site serves them all.

export type Route =
  | { readonly view: "fleet" | "cloudwatch" }
  | { readonly view: "car" | "history"; readonly robot: string };

export function route(to: Route): string {
  if ("robot" in to) return `#/${to.view}/${encodeURIComponent(to.robot)}`;
  return to.view === "fleet" ? "#/" : `#/${to.view}`;
}

export function readRoute(hash: string): Route {
  const [, view, robot] = /^#\/([a-z]+)(?:\/([A-Za-z0-9_-]{1,64}))?$/.exec(hash) ?? [];
  if ((view === "car" || view === "history") && robot !== undefined) return { view, robot };
  return { view: view === "cloudwatch" ? "cloudwatch" : "fleet" };
}
