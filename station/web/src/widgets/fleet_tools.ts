// Which cars the fleet's view shows and in which order: search, sort and group, kept in the address and in this browser.

import type { FieldTable } from "../base/contract";
import { byName, choices, el, form } from "../base/dom";
import { keep, kept } from "../base/kept";
import { type Query, setAddress } from "../base/route";
import type { Registry } from "../live/registry";
import { hottest, type Robot } from "../live/robot";
import { numeric } from "../live/stream";

/** The orders, and what is compared: the smallest comes first, and a car without a value last. */
const SORTS: Readonly<
  Record<
    string,
    { readonly label: string; readonly of: (robot: Robot, table: FieldTable, now: number) => number }
  >
> = {
  name: { label: "Name", of: () => 0 },
  trouble: {
    label: "Trouble first",
    of: (robot, table, now) =>
      robot.fault(table) !== undefined ? 0 : { gone: 1, stale: 2, idle: 3, live: 3 }[robot.freshness(now)],
  },
  battery: { label: "Lowest battery", of: (robot, table) => newest(robot, table)("voltage_input") },
  temperature: { label: "Hottest", of: (robot, table) => -hottest(newest(robot, table)) },
  speed: { label: "Fastest", of: (robot, table) => -Math.abs(newest(robot, table)("speed")) },
};

const newest =
  (robot: Robot, table: FieldTable) =>
  (field: string): number =>
    numeric(robot.vesc(table)?.sample.get(field));

export class FleetTools {
  readonly node: HTMLElement;
  private readonly find = el("input", {
    type: "search",
    name: "find",
    placeholder: "Name or tag",
    "aria-label": "Find cars",
  });
  private readonly sort = el(
    "select",
    { name: "sort" },
    ...choices(Object.entries(SORTS).map(([value, { label }]) => [value, label] as const)),
  );
  private readonly group = el("select", { name: "group" });
  private readonly grouping = el("label", { hidden: "" }, "Group by ", this.group);
  private wanted = "";
  private known = "";

  constructor(
    private readonly registry: Registry,
    private readonly table: FieldTable,
    private readonly changed: () => void,
  ) {
    const sorting = el("label", {}, "Sort by ", this.sort);
    const attributes = { class: "range fleet-tools", role: "search" };
    this.node = form(attributes, () => undefined, this.find, sorting, this.grouping);
    for (const each of [this.find, this.sort, this.group])
      each.addEventListener("input", () => this.choose());
  }

  /** Take the address's choices, or the ones of the last visit. */
  read({
    find = "",
    sort = kept("fleet.sort") ?? "name",
    group = kept("fleet.group") ?? "",
  }: Query<"fleet">): void {
    this.find.value = find;
    this.sort.value = Object.hasOwn(SORTS, sort) ? sort : "name";
    this.wanted = group;
    this.offer();
  }

  /** Put the cursor into the search. */
  focus(): void {
    this.find.focus();
    this.find.select();
  }

  /** Offer the tags that cars have. */
  offer(): void {
    const names = [...new Set(Object.values(this.registry.tags).flatMap((tags) => Object.keys(tags)))].sort(
      byName,
    );
    if (String(names) !== this.known) {
      this.known = String(names);
      this.group.replaceChildren(el("option", { value: "" }, "Nothing"), ...choices(names));
    }
    this.grouping.hidden = names.length === 0;
    this.group.value = names.includes(this.wanted) ? this.wanted : "";
  }

  /** Whether a car's name or one of its tags has every word of the search. */
  finds(robot: string): boolean {
    const tags = Object.entries(this.registry.tags[robot] ?? {}).map(([name, value]) => `${name}=${value}`);
    const text = [robot, ...tags].join(" ").toLowerCase();
    return this.find.value
      .toLowerCase()
      .split(/\s+/)
      .every((word) => text.includes(word));
  }

  /** The cars by their group's heading; without groups, the heading is empty. */
  arrange(robots: readonly Robot[], now: number): Map<string, Robot[]> {
    const { of } = SORTS[this.sort.value]!;
    const keys = new Map(robots.map((robot) => [robot, of(robot, this.table, now)] as const));
    const key = (robot: Robot): number => (Number.isNaN(keys.get(robot)!) ? Infinity : keys.get(robot)!);
    const ordered = [...robots].sort((a, b) =>
      key(a) === key(b) ? byName(a.name, b.name) : key(a) - key(b),
    );
    const tag = this.group.value;
    const heading = (robot: Robot): string =>
      tag === "" ? "" : (this.registry.tag(robot.name, tag) ?? `no ${tag}`);
    const groups = new Map<string, Robot[]>();
    for (const name of [...new Set(robots.map(heading))].sort(byName)) groups.set(name, []);
    for (const robot of ordered) groups.get(heading(robot))!.push(robot);
    return groups;
  }

  private choose(): void {
    this.wanted = this.group.value;
    keep("fleet.sort", this.sort.value);
    keep("fleet.group", this.group.value);
    const told = (value: string, plain: string): string | undefined => (value === plain ? undefined : value);
    setAddress({
      view: "fleet",
      query: {
        find: told(this.find.value, ""),
        sort: told(this.sort.value, "name"),
        group: told(this.group.value, ""),
      },
    });
    this.changed();
  }
}
