// The views, their addresses and parameters: #/history/car7?stream=vesc. They are behind the #, so that a
// static site serves them all, and a link shows what its sender saw.

import { NAME } from "./contract";
import { type Range, readRange, readTime, writeTime } from "./range";

/** Each view's parameters. To add one, add its name. */
const PARAMETERS = {
  fleet: ["find", "sort", "group"],
  car: ["window", "charts"],
  history: ["stream", "from", "to", "fields", "at"],
  insights: ["drive", "laps"],
  compare: ["runs", "stream", "fields", "x", "zoom"],
  cloudwatch: [],
  alarms: [],
} as const;

/** A robot's range: a run, a lap, or any other. */
export interface Part {
  readonly robot: string;
  readonly range: Range;
}

/** The most ranges that are compared. */
export const MOST_PARTS = 6;

type View = keyof typeof PARAMETERS;
export type Query<V extends View> = Readonly<
  Partial<Record<(typeof PARAMETERS)[V][number], string | undefined>>
>;

interface Address<V extends View> {
  readonly view: V;
  readonly query?: Query<V>;
}
interface RobotAddress<V extends View> extends Address<V> {
  readonly robot: string;
}
export type Route =
  | Address<"fleet">
  | Address<"cloudwatch">
  | Address<"alarms">
  | Address<"compare">
  | RobotAddress<"car">
  | RobotAddress<"history">
  | (Address<"insights"> & { readonly robot?: string });

export type RouteTo<V extends View> = Extract<Route, { readonly view: V }>;

export function route(to: Route): string {
  const view = to.view === "fleet" ? "" : to.view;
  const robot = "robot" in to && to.robot !== undefined ? `/${encodeURIComponent(to.robot)}` : "";
  const pairs = Object.entries<string | undefined>(to.query ?? {}).filter(([, value]) => value !== undefined);
  const query = pairs.map(
    ([name, value]) => `${name}=${encodeURIComponent(value!).replace(/%(2C|2F|3A)/g, decodeURIComponent)}`,
  );
  return `#/${view}${robot}${query.length > 0 ? `?${query.join("&")}` : ""}`;
}

export function readRoute(hash: string): Route {
  const [, name = "", robot, query = ""] =
    /^#\/([a-z]*)(?:\/([A-Za-z0-9_-]{1,64}))?(?:\?(.*))?$/.exec(hash) ?? [];
  const values = new URLSearchParams(query);
  const read = <V extends View>(view: V): Query<V> =>
    Object.fromEntries(
      PARAMETERS[view].flatMap((key) => (values.has(key) ? [[key, values.get(key)]] : [])),
    ) as Query<V>;
  if ((name === "car" || name === "history") && robot !== undefined)
    return { view: name, robot, query: read(name) };
  if (name === "insights")
    return { view: name, ...(robot === undefined ? {} : { robot }), query: read(name) };
  if (name === "cloudwatch" || name === "alarms" || name === "compare")
    return { view: name, query: read(name) };
  return { view: "fleet", query: read("fleet") };
}

type Word = readonly [reads: (value: string) => boolean, must: string];
const TIME: Word = [(value) => !Number.isNaN(readTime(value)), "be a time like 2026-05-04T10:00:00.000Z"];
const WORDS: Readonly<Record<string, Word>> = {
  from: TIME,
  to: TIME,
  at: TIME,
  stream: [(value) => NAME.test(value), "be a stream's name"],
  runs: [
    (value) =>
      value === "" ||
      (readParts(value).length === value.split(",").length && readParts(value).length <= MOST_PARTS),
    `be at most ${MOST_PARTS} ranges like car1/2026-05-04T10:00:00.000Z/2026-05-04T10:05:00.000Z`,
  ],
  x: [(value) => value === "time" || value === "distance", "be time or distance"],
  zoom: [(value) => /^[-\d.]+,[-\d.]+$/.test(value), "be two numbers"],
  window: [(value) => /^\d+$/.test(value), "be a number of seconds"],
};

/** What of an address is not shown because it cannot be read, for the viewer. */
export function unread(hash: string): string[] {
  const { view, query = {} } = readRoute(hash);
  const [path = "", given = ""] = hash.replace(/^#\/?/, "").split(/\?(.*)/);
  const robot = path.split("/")[1];
  if (path !== "" && (path.split("/")[0] !== view || (robot !== undefined && !NAME.test(robot))))
    return [`there is no view "${path}"`];
  const names: readonly string[] = PARAMETERS[view];
  const values = [...new URLSearchParams(given)].map(([name, value]) => {
    if (!names.includes(name)) return `${view} has no parameter ${name}`;
    const [reads, must] = WORDS[name] ?? [];
    return reads && !reads(value) ? `${name} must ${must}, got "${value}"` : "";
  });
  const { from, to } = query as Query<"history">;
  const order =
    view === "history" &&
    (from ?? to) !== undefined &&
    values.every((text) => text === "") &&
    !readRange(from, to)
      ? ["from and to must be two times in their order"]
      : [];
  return [...values.filter((text) => text !== ""), ...order];
}

/** The address that the page has followed or written last. */
let followed: string | undefined;

/** The browser's address, which the page follows now. */
export function follow(): string {
  followed = location.hash;
  return followed;
}

/** Put what the view shows into the address, as a step of the browser's history if `step`. The view is not called. */
export function setAddress(to: Route, step = false): void {
  const address = route(to);
  // The browser is at another address already, and tells the page next: what was shown before must not replace it.
  if (address === location.hash || location.hash !== followed) return;
  if (step) history.pushState(null, "", address);
  else history.replaceState(null, "", address);
  follow();
}

/** Ranges in an address: car1/2026-05-04T10:00:00.000Z/2026-05-04T10:05:00.000Z,car2/… */
export function writeParts(parts: readonly Part[]): string {
  return parts.map(({ robot, range }) => [robot, ...range.map(writeTime)].join("/")).join(",");
}

/** The ranges of an address, without those that cannot be read. */
export function readParts(text = ""): Part[] {
  return text.split(",").flatMap((part) => {
    const [robot = "", from, to] = part.split("/");
    const range = readRange(from, to);
    return NAME.test(robot) && range ? [{ robot, range }] : [];
  });
}

/** Make a link to a comparison of these parts, or say why there is none. */
export function offerComparison(
  link: HTMLAnchorElement,
  parts: readonly Part[],
  what: string,
  text: string,
  query: Query<"compare">,
): void {
  const few =
    parts.length < 2
      ? `Check two ${what} to compare them`
      : parts.length > MOST_PARTS
        ? `At most ${MOST_PARTS} ${what} can be compared`
        : "";
  link.textContent = few || text;
  if (few) link.removeAttribute("href");
  else link.href = route({ view: "compare", query: { runs: writeParts(parts), ...query } });
}
