// The triggers of a robot's event recorder: alarms of one's own, and what keeps messages, beside the robot's answers.

import type { Config, TriggerEntry, TriggersAnswer } from "../base/contract";
import { button, el, Items, panel } from "../base/dom";
import { may } from "../server/admission";
import { act, ask, Latest, words } from "../server/answers";

const ACCEPTED = "accepted";

export class AlarmsPanel {
  readonly node: HTMLElement;
  private readonly list = el("ul", { class: "notes-list" });
  private readonly items = new Items<TriggerEntry>(this.list, (trigger) => this.item(trigger));
  private readonly said = el("p", { class: "note said", role: "status" });
  private robot = "";
  private readonly loading = new Latest();

  constructor(private readonly config: Config) {
    this.node = panel("Alarms of your own", "notes own-alarms", [], this.list, this.said);
    this.node.hidden = true;
  }

  async show(robot: string): Promise<void> {
    if (robot !== this.robot) this.items.fill([]);
    this.robot = robot;
    if (!this.config.answers) return;
    await this.loading.run(
      async (signal) => this.fill((await ask<TriggersAnswer>("triggers", { robot }, signal)).triggers),
      (reason) => this.say("bad", reason),
    );
  }

  private fill(triggers: readonly TriggerEntry[]): void {
    const adds = may(this.config, "add_trigger");
    this.node.hidden = triggers.length === 0 && !adds;
    this.items.fill(triggers);
    const none = "Press Alarm on a chart: the car tells when the value is above or below a threshold.";
    this.say("", triggers.length === 0 ? none : "");
  }

  private item({ name, stream, when, notify, answer }: TriggerEntry): HTMLElement {
    const state = answer === ACCEPTED ? "accepted" : answer ? `refused: ${answer}` : "not answered yet";
    const item = el(
      "li",
      { "data-trigger": name, "data-state": answer === ACCEPTED ? "good" : answer ? "bad" : "" },
      el("span", { class: "note-text" }, name),
      el("span", { class: "state" }, state),
      el(
        "span",
        { class: "note" },
        stream ? `${stream}: ` : "",
        el("code", {}, when),
        notify ? "" : ", keeps messages",
      ),
    );
    if (notify && may(this.config, "remove_trigger"))
      item.append(
        button("Remove", () => void this.remove(name), { "aria-label": `Remove the alarm ${name}` }),
      );
    return item;
  }

  private async remove(name: string): Promise<void> {
    const { robot } = this;
    try {
      const { triggers } = await act<TriggersAnswer>("remove_trigger", { robot, name });
      if (robot === this.robot) this.fill(triggers);
    } catch (error) {
      this.say("bad", words(error));
    }
  }

  private say(kind: string, text: string): void {
    if (kind) this.node.hidden = false;
    this.said.dataset.kind = kind;
    this.said.textContent = text;
  }
}
