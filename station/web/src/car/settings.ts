// The settings of a car's agent, with what they may be. The page's server changes them as `iort config` does.

import type { SettingEntry, SettingsAnswer } from "../base/contract";
import { button, choices, el, form } from "../base/dom";
import type { Robot } from "../live/robot";
import { act, words } from "../server/answers";

type Input = HTMLInputElement | HTMLSelectElement;

/** A stream of which nothing was selected. */
const ALL_FIELDS: Omit<SettingEntry, "name"> = {
  ...{ kind: "fields", low: 0, high: 0, unit: "", names: [] },
  ...{ value: "", desired: false, pending: null, reason: "" },
};

export class Settings {
  readonly node: HTMLDetailsElement;
  private readonly rows = el("div", { class: "settings" });
  private readonly said = el("p", { class: "note said", role: "status" });
  private name = "";
  private robot: Robot | undefined;

  constructor() {
    const title = el("summary", {}, el("h3", {}, "Settings"));
    this.node = el("details", { class: "panel control-panel" }, title, this.rows, this.said);
    this.node.addEventListener("toggle", () => void this.load());
  }

  /** Change this car's settings from now on. */
  of(name: string): void {
    if (name === this.name) return;
    this.name = name;
    this.rows.replaceChildren();
    void this.load();
  }

  /** The car whose streams can be selected from. */
  heard(robot: Robot | undefined): void {
    this.robot = robot;
  }

  private async load(): Promise<void> {
    if (this.node.open) await this.ask("settings", {});
  }

  /** Ask, and show the settings of the answer. */
  private async ask(action: "settings" | "set", parameters: Readonly<Record<string, string>>): Promise<void> {
    const { name } = this;
    this.say("", action === "set" ? `Waiting for ${name} …` : "Loading …");
    try {
      const answer = await act<SettingsAnswer>(action, { robot: name, ...parameters });
      if (name === this.name) this.draw(answer);
    } catch (error) {
      if (name === this.name) this.say("bad", words(error));
    }
  }

  private draw({ settings, online }: SettingsAnswer): void {
    const known = new Set(settings.map(({ name }) => name));
    const free = [...(this.robot?.streams.keys() ?? [])]
      .map((stream) => `fields.${stream}`)
      .filter((name) => !known.has(name));
    const fields = free.map((name): SettingEntry => ({ ...ALL_FIELDS, name }));
    this.rows.replaceChildren(...[...settings, ...fields].map((entry) => this.row(entry)));
    const waits = settings.some(({ pending }) => pending !== null);
    const why = online
      ? "The agent has not answered yet."
      : "The car is offline. It applies what is pending when it is back.";
    this.say("", waits ? why : "");
  }

  private row(entry: SettingEntry): HTMLElement {
    const { name, value, pending, desired, reason, unit } = entry;
    const input = inputOf(entry);
    input.setAttribute("name", name);
    input.value = pending ?? value;
    const set = el(
      "button",
      { type: "submit", class: "tool", "aria-label": `Set ${name}`, hidden: "" },
      "Set",
    );
    const undo = button("Reset", () => void this.ask("set", { name }), {
      title: "Return to the value of car.yaml",
      "aria-label": `Reset ${name}`,
    });
    undo.hidden = !desired;
    const waiting = `${pending === "" ? "all fields are pending" : "pending"}; in force is ${value || "car.yaml's"}`;
    const note = reason
      ? el("p", { class: "said", "data-kind": "bad" }, `rejected: ${reason}`)
      : el("p", { class: "said" }, pending === null ? "" : waiting);
    input.addEventListener("input", () => (set.hidden = input.value === (pending ?? value)));
    return form(
      { class: "setting" },
      () => void this.ask("set", { name, value: input.value }),
      el("label", {}, name, input, ...(unit ? [el("span", { class: "unit" }, unit)] : [])),
      set,
      undo,
      ...(reason || pending !== null ? [note] : []),
    );
  }

  private say(kind: string, text: string): void {
    this.said.dataset.kind = kind;
    this.said.textContent = text;
  }
}

/** An input that takes only what the agent accepts. */
function inputOf({ kind, low, high, names, value }: SettingEntry): Input {
  if (kind === "number")
    return el("input", { type: "number", min: String(low), max: String(high), step: "any", required: "" });
  if (kind === "fields")
    return el("input", { type: "text", placeholder: "all fields", spellcheck: "false", autocomplete: "off" });
  const known = kind === "flag" ? ["true", "false"] : names;
  return el("select", {}, ...choices(value === "" ? ["", ...known] : known));
}
