// The views, their addresses and parameters: #/history/car7?stream=vesc. They are behind the #, so that a
// static site serves them all, and a link shows what its sender saw.

/** Each view's parameters. To add one, add its name. */
const PARAMETERS = {
  fleet: ["find", "sort", "group"],
  car: ["window", "charts"],
  history: ["stream", "from", "to"],
  cloudwatch: [],
  alarms: [],
} as const;

type View = keyof typeof PARAMETERS;
export type Query<V extends View> = Readonly<Partial<Record<(typeof PARAMETERS)[V][number], string | undefined>>>;

interface Address<V extends View> {
  readonly view: V;
  readonly query?: Query<V>;
}
interface RobotAddress<V extends View> extends Address<V> {
  readonly robot: string;
}
export type Route = Address<"fleet"> | Address<"cloudwatch"> | Address<"alarms"> | RobotAddress<"car"> | RobotAddress<"history">;

export function route(to: Route): string {
  const view = to.view === "fleet" ? "" : to.view;
  const robot = "robot" in to ? `/${encodeURIComponent(to.robot)}` : "";
  const pairs = Object.entries<string | undefined>(to.query ?? {}).filter(([, value]) => value !== undefined);
  const query = pairs.map(([name, value]) => `${name}=${encodeURIComponent(value!).replace(/%(2C|2F|3A)/g, decodeURIComponent)}`);
  return `#/${view}${robot}${query.length > 0 ? `?${query.join("&")}` : ""}`;
}

export function readRoute(hash: string): Route {
  const [, name = "", robot, query = ""] = /^#\/([a-z]*)(?:\/([A-Za-z0-9_-]{1,64}))?(?:\?(.*))?$/.exec(hash) ?? [];
  const values = new URLSearchParams(query);
  const read = <V extends View>(view: V): Query<V> =>
    Object.fromEntries(PARAMETERS[view].flatMap((key) => (values.has(key) ? [[key, values.get(key)]] : []))) as Query<V>;
  if ((name === "car" || name === "history") && robot !== undefined) return { view: name, robot, query: read(name) };
  if (name === "cloudwatch") return { view: name, query: read(name) };
  if (name === "alarms") return { view: name, query: read(name) };
  return { view: "fleet", query: read("fleet") };
}

/** Put what the view shows into the address, as a step of the browser's history if `step`. The view is not called. */
export function setAddress(to: Route, step = false): void {
  const address = route(to);
  if (address === location.hash) return;
  if (step) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
}
