// One command to a car, and the car's answer. The page's server sends it as `iort send` does.

import { MAX_LEASE_MS, type SendAnswer } from "../base/contract";
import { button, choices, el, form } from "../base/dom";
import { age } from "../base/format";
import { keep, kept } from "../base/kept";
import { act, words } from "../server/answers";

type Message = Readonly<Record<string, unknown>>;

/** The ROS messages that drive a car, and the unit of their second number. Any other message is typed as JSON. */
const MESSAGES: Readonly<
  Record<
    string,
    { readonly turn: string; readonly unit: string; readonly of: (speed: number, turn: number) => Message }
  >
> = {
  AckermannDriveStamped: {
    turn: "Steering",
    unit: "rad",
    of: (speed, turn) => ({ drive: { speed, steering_angle: turn } }),
  },
  AckermannDrive: { turn: "Steering", unit: "rad", of: (speed, turn) => ({ speed, steering_angle: turn }) },
  Twist: {
    turn: "Turn",
    unit: "rad/s",
    of: (speed, turn) => ({ linear: { x: speed }, angular: { z: turn } }),
  },
};
const FIRST = "AckermannDriveStamped";
const LEASE_MS = 500;
const NUMBER = { type: "number" };

export class Commands {
  readonly node: HTMLElement;
  private readonly command = el("input", {
    name: "command",
    value: kept("car.command") ?? "drive",
    required: "",
    pattern: "[A-Za-z0-9_\\-]{1,64}",
    autocomplete: "off",
  });
  private readonly type = el("select", { name: "type" }, ...choices([...Object.keys(MESSAGES), "JSON"]));
  private readonly speed = el("input", { ...NUMBER, name: "speed", value: "0.5", step: "0.1", required: "" });
  private readonly turn = el("input", { ...NUMBER, name: "turn", value: "0", step: "0.05", required: "" });
  private readonly turnLabel = el("span");
  private readonly turnUnit = el("span", { class: "unit" });
  private readonly lease = el("input", {
    ...NUMBER,
    name: "lease",
    value: String(LEASE_MS),
    min: "1",
    max: String(MAX_LEASE_MS),
    step: "1",
  });
  private readonly blind = el("input", { type: "checkbox", name: "blind" });
  private readonly json = el(
    "textarea",
    { name: "message", rows: "3", spellcheck: "false", "aria-label": "ROS message as JSON" },
    "{}",
  );
  private readonly drive: HTMLElement;
  private readonly stop = button(
    "Stop",
    // Nobody needs a picture to let it stand.
    () => void this.send(MESSAGES[this.type.value]!.of(0, 0), String(LEASE_MS), true),
    { class: "tool stop" },
  );
  private readonly said = el("p", { class: "note said", role: "status" });
  private robot = "";
  private sending = 0;

  constructor() {
    const known = kept("car.message") ?? FIRST;
    this.type.value = Object.hasOwn(MESSAGES, known) || known === "JSON" ? known : FIRST;
    const pair = (...fields: Node[]): HTMLElement => el("div", { class: "pair" }, ...fields);
    const unit = (text: string): HTMLElement => el("span", { class: "unit" }, text);
    this.drive = pair(
      el("label", {}, "Speed", this.speed, unit("m/s")),
      el("label", {}, this.turnLabel, this.turn, this.turnUnit),
    );
    const body = form(
      { class: "control" },
      () => this.submit(),
      pair(el("label", {}, "Command", this.command), el("label", {}, "Message", this.type)),
      this.drive,
      this.json,
      pair(
        el("label", { title: "How long the car may move, from now" }, "For", this.lease, unit("ms")),
        el("label", { title: "Move a car with a camera without its picture" }, this.blind, "Blind"),
      ),
      pair(el("button", { type: "submit", class: "tool primary" }, "Send"), this.stop),
      this.said,
    );
    this.type.addEventListener("input", () => this.shape());
    const title = el("summary", {}, el("h3", {}, "Commands"));
    this.node = el("details", { class: "panel control-panel" }, title, body);
    this.shape();
  }

  /** Send to this car from now on. */
  of(robot: string): void {
    if (robot === this.robot) return;
    this.robot = robot;
    this.blind.checked = false;
    this.said.textContent = "";
  }

  /** Show the fields of the chosen message. */
  private shape(): void {
    const known = MESSAGES[this.type.value];
    this.drive.hidden = this.stop.hidden = known === undefined;
    this.json.hidden = known !== undefined;
    for (const each of [this.speed, this.turn]) each.disabled = known === undefined;
    if (known) [this.turnLabel.textContent, this.turnUnit.textContent] = [known.turn, known.unit];
  }

  private submit(): void {
    const known = MESSAGES[this.type.value];
    try {
      const message = known
        ? known.of(this.speed.valueAsNumber, this.turn.valueAsNumber)
        : (JSON.parse(this.json.value) as Message);
      void this.send(message, this.lease.value, this.blind.checked);
    } catch (error) {
      this.say("bad", `The message must be JSON: ${error instanceof Error ? error.message : String(error)}`);
    }
  }

  private async send(message: Message, lease_ms: string, blind: boolean): Promise<void> {
    const [robot, command] = [this.robot, this.command.value];
    keep("car.command", command);
    keep("car.message", this.type.value);
    const sending = (this.sending += 1);
    this.say("", `Waiting for ${robot} …`);
    const outcome = await act<SendAnswer>("send", {
      robot,
      command,
      message: JSON.stringify(message),
      lease_ms,
      ...(blind ? { blind: "true" } : {}),
    }).then(
      (answer) => outcomeOf(command, answer),
      (error: unknown) => ["bad", words(error)] as const,
    );
    // A later command's answer, and another car's, must not be replaced by this one.
    if (sending === this.sending && robot === this.robot) this.say(outcome[0], outcome[1]);
  }

  private say(kind: string, text: string): void {
    this.said.dataset.kind = kind;
    this.said.textContent = text;
  }
}

/** Whether the car has taken a command, and the words for the viewer. */
function outcomeOf(
  command: string,
  { accepted, reason, after_ms }: SendAnswer,
): readonly ["good" | "bad", string] {
  const after = age(after_ms / 1000);
  if (accepted) return ["good", `${command} accepted after ${after}`];
  if (accepted === false) return ["bad", `${command} rejected: ${reason.replaceAll("_", " ")}`];
  const missing = `No answer within ${after}. Does its agent run, and has its car.yaml downlink.cmd.${command}?`;
  return ["bad", reason || missing];
}
