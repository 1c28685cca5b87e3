// What a car's event recorder has kept: a list, its files, and a button that has it keep the last minute.

import type { Config, IncidentEntry, IncidentsAnswer, KeepAnswer } from "../base/contract";
import { button, el, onPress, panel, setAttribute, Text } from "../base/dom";
import { age, number, when } from "../base/format";
import { inUs, type Range, writeTime } from "../base/range";
import { route } from "../base/route";
import { bytes } from "../live/attachments";
import { may } from "../server/admission";
import { act, ask, Latest, words } from "../server/answers";
import { foxglove } from "./foxglove";
import { IncidentPictures } from "./incident_pictures";
import { save } from "./saving";

/** How much the button keeps, and the box of a note. */
export const KEEP_S = 60;
// Without a range: the last days, asked again so often; sooner while a car is to send something.
const RECENT_S = 7 * 86_400;
const [AGAIN_S, SOON_S] = [60, 5];
// An upload takes about so long, once the car has accepted it.
const UPLOAD_S = 60;
/** The history around an incident, in seconds before and after it. */
const AROUND_S = 10;

/** The states, for a viewer. */
const STATES: Readonly<Record<string, string>> = {
  kept: "on the car",
  uploaded: "uploaded",
  notified: "told only",
  over_budget: "over budget",
  lost: "lost",
};

export interface IncidentsOptions {
  /** Other incidents are shown, the oldest first. A list's letter is the place here: see `letter`. */
  readonly shown?: (incidents: readonly IncidentEntry[]) => void;
}

const now = (): number => Date.now() / 1000;

/** A, B, ... Z, AA: notes have numbers. */
export const letter = (place: number): string =>
  (place < 26 ? "" : letter(Math.floor(place / 26) - 1)) + String.fromCharCode(65 + (place % 26));

export class IncidentsPanel {
  readonly node: HTMLElement;
  private readonly list = el("ul", { class: "notes-list incidents-list" });
  private readonly said = el("p", { class: "note said", role: "status" });
  private readonly keeps: boolean;
  private readonly loading = new Latest();
  private readonly saving = new Latest();
  private readonly pictures = new IncidentPictures();
  private robot: string | undefined;
  private range: Range | undefined;
  private drawn = "";
  private keeping = 0;
  private timer: number | undefined;
  private stopped = true;
  /** The list says why it could not be read. */
  private failed = false;
  /** Until then something is to come, in seconds since 1970. */
  private soonUntil = 0;

  constructor(
    private readonly config: Config,
    private readonly options: IncidentsOptions = {},
  ) {
    this.keeps = options.shown === undefined && may(config, "keep");
    const keep = button(`Keep the last ${KEEP_S} s`, undefined, {
      title: "Upload what the car's recorder has of them",
    });
    onPress(keep, () => void this.keep());
    this.node = panel("Incidents", "notes incidents", this.keeps ? [keep] : [], this.list, this.said);
    this.node.hidden = true;
  }

  /** Show a car's incidents: those of a range, or the newest, again and again. */
  show(robot: string, range?: Range): void {
    if (robot !== this.robot) {
      this.fill([]);
      this.say("", "");
      this.saving.stop();
    }
    [this.robot, this.range, this.stopped] = [robot, range, false];
    void this.load();
  }

  /** The car is to keep something: its sample comes a moment after its answer. */
  expect(): void {
    this.soonUntil = now() + UPLOAD_S;
    this.again(1);
  }

  /** Ask no more. */
  stop(): void {
    this.stopped = true;
    window.clearTimeout(this.timer);
    this.loading.stop();
    this.saving.stop();
    this.pictures.clear();
    // What has no picture yet asks for it again.
    this.drawn = "";
  }

  private async load(): Promise<void> {
    const { robot, range } = this;
    window.clearTimeout(this.timer);
    if (!this.config.answers || robot === undefined) return;
    if (!document.hidden)
      await this.loading.run(
        async (signal) => {
          const asked = range ? inUs(range) : { from_us: String(Math.round(now() - RECENT_S) * 1e6) };
          const { incidents } = await ask<IncidentsAnswer>("incidents", { robot, ...asked }, signal);
          this.fill(incidents);
          if (this.failed) this.say("", "");
          this.failed = false;
          if (incidents.some(({ state }) => state === "kept")) this.soonUntil = now() + 2 * SOON_S;
        },
        (reason) => {
          this.failed = true;
          this.say("bad", reason);
        },
      );
    if (range || robot !== this.robot || this.range) return;
    this.again(now() < this.soonUntil ? SOON_S : AGAIN_S);
  }

  private again(after_s: number): void {
    window.clearTimeout(this.timer);
    if (!this.stopped) this.timer = window.setTimeout(() => void this.load(), after_s * 1000);
  }

  private async keep(): Promise<void> {
    const robot = this.robot!;
    const keeping = (this.keeping += 1);
    this.say("", `Waiting for ${robot} …`);
    const [kind, text] = await act<KeepAnswer>("keep", { robot, last_s: String(KEEP_S) }).then(
      (answer) => answered(robot, answer),
      (error: unknown) => ["bad", words(error)] as const,
    );
    if (robot !== this.robot || keeping !== this.keeping) return;
    this.failed = false;
    this.say(kind, text);
    this.expect();
  }

  private fill(newest: readonly IncidentEntry[]): void {
    // What has not changed keeps the focus on its buttons.
    const drawn = JSON.stringify(newest);
    if (drawn !== this.drawn) {
      this.pictures.clear();
      const last = newest.length - 1;
      this.list.replaceChildren(...newest.map((incident, i) => this.item(incident, last - i)));
      this.options.shown?.([...newest].reverse());
    }
    this.drawn = drawn;
    this.node.hidden = newest.length === 0 && !this.keeps;
  }

  private item(incident: IncidentEntry, place: number): HTMLElement {
    const { robot, id, from_us, to_us, trigger, condition, state, why, by, missing } = incident;
    const [from, to] = [from_us / 1e6, to_us / 1e6];
    const query = { from: writeTime(from - AROUND_S), to: writeTime(to + AROUND_S) };
    const size = incident.bytes > 0 ? [bytes(incident.bytes), `${number(incident.messages)} messages`] : [];
    const lacks = missing > 0 ? [`${number(missing)} missing`] : [];
    const told = [why, by ? `by ${by}` : ""].filter(Boolean);
    const about = el(
      "div",
      { class: "incident" },
      ...(this.options.shown ? [el("b", { class: "mark" }, letter(place))] : []),
      el("span", { class: "note-text", title: condition }, trigger.split(",").join(", ")),
      el("span", { class: "state" }, STATES[state] ?? state),
      el(
        "span",
        { class: "note" },
        el("a", { href: route({ view: "history", robot, query }) }, when(from)),
        `, ${[age(to - from), ...size, ...lacks, ...told].join(", ")}`,
      ),
    );
    const asked = { robot, id, from_us: String(from_us) };
    const item = el("li", { "data-incident": id, "data-state": state }, about);
    if (state === "uploaded") {
      item.prepend(this.pictures.of(asked, `${trigger}, ${when(from)}`));
      const note = new Text("note", "span", { role: "status" });
      const load = (): void => {
        note.set("Reading the file …");
        void save("incident.mcap", asked, note, this.saving);
      };
      const label = `Download the incident ${trigger}, ${when(from)}`;
      const open = foxglove(
        () => `--incident ${id}`,
        `Open the incident ${trigger} in Foxglove, ${when(from)}`,
      );
      about.append(button("Download", load, { "aria-label": label }), open, note.node);
    }
    return item;
  }

  private say(kind: string, text: string): void {
    setAttribute(this.said, "data-kind", kind);
    this.said.textContent = text;
  }
}

/** What the car has said, and its words for the viewer. */
function answered(
  robot: string,
  { accepted, reason, online }: KeepAnswer,
): readonly ["good" | "bad" | "", string] {
  if (accepted) return ["good", `${robot} keeps them, and uploads them.`];
  if (accepted === false) return ["bad", `${robot} refuses: ${reason}`];
  if (online) return ["bad", `No answer. Does its agent run, and has its car.yaml the section recorder?`];
  return ["", `${robot} is not connected: it keeps them when it is back, as far as its ring reaches.`];
}
