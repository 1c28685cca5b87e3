// People's notes about a car, or the fleet: a list, and a form that writes one where the server allows it.

import { type Config, MAX_NOTE_CHARACTERS, type NoteEntry, type NotesAnswer } from "../base/contract";
import { button, el, form, panel } from "../base/dom";
import { when } from "../base/format";
import { inUs, type Range, writeTime } from "../base/range";
import { route } from "../base/route";
import { may } from "../server/admission";
import { act, ask, Latest, words } from "../server/answers";

/** The history around a note, in seconds before and after it. */
const AROUND_S = 30;

export interface NotesOptions {
  /** The time that a new note is about, in seconds; without it, now. */
  readonly at?: () => number;
  /** Other notes are shown, the oldest first. A list's number is the place here, from 1. */
  readonly shown?: (notes: readonly NoteEntry[]) => void;
}

export class NotesPanel {
  readonly node: HTMLElement;
  private readonly list = el("ul", { class: "notes-list" });
  private readonly said = el("p", { class: "note said", role: "status" });
  private readonly text = el("input", {
    type: "text",
    name: "note",
    maxlength: String(MAX_NOTE_CHARACTERS),
    required: "",
    autocomplete: "off",
    "aria-label": "Note",
  });
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
    this.form = form({ class: "range note-form" }, () => void this.write(), this.text, add);
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
    this.say("", "Writing …");
    try {
      await act<NotesAnswer>("note", { robot: robot!, text: this.text.value, ...time });
      this.text.value = "";
      if (robot === this.robot) await this.load();
    } catch (error) {
      this.say("bad", words(error));
    }
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
    this.list.replaceChildren(...notes.map((note, i) => this.item(note, i + 1)).reverse());
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
