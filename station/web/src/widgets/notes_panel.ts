// People's notes about a car, or the fleet: a list, and a form that writes one where the server allows it.

import { type Config, MAX_NOTE_CHARACTERS, type NoteEntry, type NotesAnswer } from "../base/contract";
import { el } from "../base/dom";
import { when } from "../base/format";
import { type Range, writeTime } from "../base/range";
import { route } from "../base/route";
import { may } from "../server/admission";
import { AnswerError, act, ask } from "../server/answers";

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
  private loading: AbortController | undefined;

  constructor(
    private readonly config: Config,
    private readonly options: NotesOptions = {},
  ) {
    this.text.placeholder = options.at ? "What happened at this time?" : "What happened?";
    this.form = el(
      "form",
      { class: "range note-form" },
      this.text,
      el("button", { type: "submit", class: "tool" }, "Add note"),
    );
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.write();
    });
    this.node = el(
      "section",
      { class: "panel notes", "aria-label": "Notes" },
      el("header", {}, el("h3", {}, "Notes")),
      this.list,
      this.form,
      this.said,
    );
  }

  /** Show the notes about a car, of a range if there is one; undefined for the fleet's. */
  async show(robot: string | undefined, range?: Range): Promise<void> {
    if (robot !== this.robot) this.fill([]);
    [this.robot, this.range] = [robot, range];
    this.form.hidden = robot === undefined || !may(this.config, "note");
    if (this.config.answers) await this.load();
  }

  private async load(): Promise<void> {
    this.loading?.abort();
    const loading = (this.loading = new AbortController());
    const [from, to] = this.range?.map((at) => String(Math.round(at * 1e6))) ?? [];
    const asked = {
      ...(this.robot === undefined ? {} : { robot: this.robot }),
      ...(from === undefined ? {} : { from_us: from, to_us: to! }),
    };
    try {
      const { notes } = await ask<NotesAnswer>("notes", asked, loading.signal);
      if (loading.signal.aborted) return;
      this.fill(notes);
      this.say("", "");
    } catch (error) {
      if (!loading.signal.aborted) this.fail(error);
    }
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
      this.fail(error);
    }
  }

  private async remove({ robot, id }: NoteEntry): Promise<void> {
    try {
      await act<NotesAnswer>("delete_note", { robot, id });
      await this.load();
    } catch (error) {
      this.fail(error);
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
    const remove = el(
      "button",
      { type: "button", class: "tool", "aria-label": `Delete the note: ${text.slice(0, 60)}` },
      "Delete",
    );
    remove.addEventListener("click", () => {
      if (remove.dataset.sure === "true") void this.remove(note);
      remove.dataset.sure = "true";
      remove.textContent = "Really delete";
    });
    remove.addEventListener("blur", () => {
      remove.dataset.sure = "false";
      remove.textContent = "Delete";
    });
    item.append(remove);
    return item;
  }

  private fail(error: unknown): void {
    this.say("bad", error instanceof AnswerError ? error.message : String(error));
  }

  private say(kind: string, text: string): void {
    this.said.dataset.kind = kind;
    this.said.textContent = text;
  }
}
