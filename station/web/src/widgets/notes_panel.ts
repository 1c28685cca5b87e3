// People's notes about a car, or the fleet: a list, and a form that writes one where the server allows it.

import { type Config, MAX_NOTE_CHARACTERS, type NoteEntry, type NotesAnswer } from "../base/contract";
import { button, el, form, Items, panel } from "../base/dom";
import { when } from "../base/format";
import { inUs, type Range, writeTime } from "../base/range";
import { route } from "../base/route";
import { may } from "../server/admission";
import { act, ask, Latest, words } from "../server/answers";
import { KEEP_S } from "./incidents_panel";

/** The history around a note, in seconds before and after it. */
const AROUND_S = 30;

export interface NotesOptions {
  /** The time that a new note is about, in seconds; without it, now. */
  readonly at?: () => number;
  /** Other notes are shown, the oldest first. A list's number is the place here, from 1. */
  readonly shown?: (notes: readonly NoteEntry[]) => void;
  /** The car is to keep what was before a note. */
  readonly kept?: () => void;
}

export class NotesPanel {
  readonly node: HTMLElement;
  private readonly list = el("ul", { class: "notes-list" });
  private readonly items = new Items<readonly [NoteEntry, number]>(this.list, (entry) => this.item(...entry));
  private readonly said = el("p", { class: "note said", role: "status" });
  private readonly text = el("input", {
    type: "text",
    name: "note",
    maxlength: String(MAX_NOTE_CHARACTERS),
    required: "",
    autocomplete: "off",
    "aria-label": "Note",
  });
  private readonly keep = el("input", { type: "checkbox", name: "keep" });
  private readonly form: HTMLElement;
  private robot: string | undefined;
  private range: Range | undefined;
  private readonly loading = new Latest();

  constructor(
    private readonly config: Config,
    private readonly options: NotesOptions = {},
  ) {
    this.text.placeholder = options.at ? "What happened at this time?" : "What happened?";
    const add = el("button", { type: "submit", class: "tool" }, "Add note");
    const title = "Upload what the car's recorder has of the time before it";
    const keep = may(config, "keep") ? [el("label", { title }, this.keep, ` Keep ${KEEP_S} s`)] : [];
    this.form = form({ class: "range note-form" }, () => void this.write(), this.text, ...keep, add);
    this.node = panel("Notes", "notes", [], this.list, this.form, this.said);
  }

  /** Show the notes about a car, of a range if there is one; undefined for the fleet's. */
  async show(robot: string | undefined, range?: Range): Promise<void> {
    if (robot !== this.robot) this.fill([]);
    [this.robot, this.range] = [robot, range];
    this.form.hidden = robot === undefined || !may(this.config, "note");
    if (this.config.answers) await this.load();
  }

  private async load(): Promise<void> {
    const { robot, range } = this;
    const asked = { ...(robot === undefined ? {} : { robot }), ...(range ? inUs(range) : {}) };
    await this.loading.run(
      async (signal) => {
        this.fill((await ask<NotesAnswer>("notes", asked, signal)).notes);
        this.say("", "");
      },
      (reason) => this.say("bad", reason),
    );
  }

  private async write(): Promise<void> {
    const { robot } = this;
    const time = this.options.at ? { t_us: String(Math.round(this.options.at() * 1e6)) } : {};
    const keep: Readonly<Record<string, string>> = this.keep.checked ? { keep_s: String(KEEP_S) } : {};
    this.say("", "Writing …");
    try {
      await act<NotesAnswer>("note", { robot: robot!, text: this.text.value, ...time, ...keep });
      this.text.value = "";
      if (robot === this.robot) await this.load();
      if (robot === this.robot && this.keep.checked) this.kept();
    } catch (error) {
      this.say("bad", words(error));
    }
  }

  /** The box is for one note. */
  private kept(): void {
    this.keep.checked = false;
    this.say("", `${this.robot} is to keep the ${KEEP_S} s before it: they come under Incidents.`);
    this.options.kept?.();
  }

  private async remove({ robot, id }: NoteEntry): Promise<void> {
    try {
      await act<NotesAnswer>("delete_note", { robot, id });
      await this.load();
    } catch (error) {
      this.say("bad", words(error));
    }
  }

  private fill(newest: readonly NoteEntry[]): void {
    const notes = [...newest].reverse();
    this.items.fill(notes.map((note, i) => [note, i + 1] as const).reverse());
    // Without the form, an empty panel says nothing.
    this.node.hidden = notes.length === 0 && (this.robot === undefined || !may(this.config, "note"));
    this.options.shown?.(notes);
  }

  private item(note: NoteEntry, number: number): HTMLElement {
    const { robot, t_us, text, by } = note;
    const at = t_us / 1e6;
    const query = { from: writeTime(at - AROUND_S), to: writeTime(at + AROUND_S), at: writeTime(at) };
    const moment = el("a", { href: route({ view: "history", robot, query }) }, when(at));
    const item = el(
      "li",
      { "data-note": note.id },
      ...(this.options.shown ? [el("b", { class: "mark" }, String(number))] : []),
      el("span", { class: "note-text" }, text),
      el("span", { class: "note" }, moment, ...(this.robot === undefined ? [`, ${robot}`] : []), `, ${by}`),
    );
    if (!may(this.config, "delete_note")) return item;
    const remove = button(
      "Delete",
      () => {
        if (remove.dataset.sure === "true") void this.remove(note);
        remove.dataset.sure = "true";
        remove.textContent = "Really delete";
      },
      { "aria-label": `Delete the note: ${text.slice(0, 60)}` },
    );
    remove.addEventListener("blur", () => {
      remove.dataset.sure = "false";
      remove.textContent = "Delete";
    });
    item.append(remove);
    return item;
  }

  private say(kind: string, text: string): void {
    this.said.dataset.kind = kind;
    this.said.textContent = text;
  }
}
