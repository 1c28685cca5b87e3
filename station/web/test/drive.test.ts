// A driver's hold of the stick, without a browser: what it means, when the car may move, why it is over.

import assert from "node:assert/strict";
import { writeFileSync } from "node:fs";
import { after, describe, test } from "node:test";
import driving from "../../../tests/unit/station/fleet/driving.json";
import { DRIVE_MAX_AGE_MS, DRIVE_MAX_RTT_MS, type DriveLimitsEntry } from "../src/base/contract";
import { onPress } from "../src/base/dom";
import { CloudClock } from "../src/drive/cloud_clock";
import { driverName } from "../src/drive/command";
import { Driver } from "../src/drive/driver";
import { Inputs } from "../src/drive/inputs";
import type { LiveMessage } from "../src/drive/live_message";
import { followed, keyed, meant, padded, pointed, type Stick } from "../src/drive/stick";

const LIMITS = driving.limits as unknown as DriveLimitsEntry;
const TICK_MS = 50;
// The cloud's clock is ahead of this computer's.
const AHEAD_MS = 3000;

interface Link {
  way: number;
  outcome: string;
  driver: string | null | undefined;
  by: string;
  silent: boolean;
  deaf: boolean;
}
interface Change {
  hold?: boolean;
  pause?: number;
  leave?: boolean;
  takeover?: boolean;
  block?: string;
  stick?: Stick;
  see?: number | null;
  shown?: false;
  blind?: boolean;
  hidden?: boolean;
  link?: Partial<Link>;
}
type Step = readonly [times: number, change?: Change];
interface Sent {
  readonly at: number;
  readonly session: string;
  readonly seq: number;
  readonly by: string;
  readonly lease_ms: number;
  readonly sent_us: number;
  readonly takeover?: boolean;
  readonly ends?: boolean;
  readonly frame?: number;
  readonly blind?: boolean;
  /** How many pictures the one that it names is older than the newest that was shown. */
  readonly behind: number | null;
  readonly message: { readonly drive: { readonly speed: number; readonly steering_angle: number } };
}
interface Drive {
  readonly sent: Sent[];
  readonly speeds: number[];
  readonly phase: string;
  readonly reason: string;
  readonly other: string;
  readonly rtt_ms: number | undefined;
  readonly driving: unknown;
}

// What the robot's own reader is asked to read: tests/web/test_logic.py.
const wire: { commands: unknown[]; names: [string[], string][] } = { commands: [], names: [] };
after(() => {
  const path = process.env.IORT_WIRE;
  if (path) writeFileSync(path, JSON.stringify(wire));
});

/** A car 40 ms away in each direction. A turn lets 50 ms pass: the car hears what was sent, and answers at 10 Hz with
 *  the outcome that is set. While `see` is a number, each time a picture of that age comes on the screen. `driven` in tests/unit/station/fleet/test_driving.py is the same for the terminal. */
function drive(steps: readonly Step[], limits = LIMITS, picture_ms?: number): Drive {
  let [now, names, due, shown] = [1e6, 0, 0, 0];
  let see: number | null = null;
  const link: Link = { way: 40, outcome: "accepted", driver: undefined, by: "", silent: false, deaf: false };
  const driver = new Driver(limits, "ada", () => `0000000${(names += 1)}`, picture_ms);
  driver.top_mps = 1;
  const sent: Sent[] = [];
  const arriving: { readonly at: number; readonly command: Sent }[] = [];
  const look = (): void => {
    if (see !== null) driver.see((shown += 1), see, now);
  };
  const turn = (): void => {
    const command = driver.tick(now);
    if (command) {
      wire.commands.push(command);
      const behind = command.frame === undefined ? null : shown - command.frame;
      const left = { ...command, at: now, behind } as unknown as Sent;
      sent.push(left);
      if (!link.deaf) arriving.push({ at: now + 2 * link.way, command: left });
    }
    now += TICK_MS;
    look();
    const heard = arriving.filter(({ at }) => at <= now);
    arriving.splice(0, heard.length);
    if (link.silent || now < due) return;
    due = now + 100;
    const cloud_ms = now + AHEAD_MS - link.way;
    const last = heard.at(-1)?.command;
    const state = {
      driver: link.driver ?? last?.session ?? "",
      driverBy: link.by || "ada",
      leaseLeft_ms: 300,
    };
    const driven = last && { session: last.session, seq: last.seq, outcome: link.outcome, ...state };
    const message = { taken_ms: cloud_ms - 2, sent_ms: cloud_ms, lay_ms: 2, next_ms: 10_000, driven };
    driver.hear(message as unknown as LiveMessage, now);
  };
  for (const [times, change = {}] of steps) {
    if (change.see !== undefined) see = change.see;
    look();
    if (change.shown === false) driver.see(undefined, undefined, now);
    driver.blind = change.blind ?? driver.blind;
    if (change.hidden !== undefined) driver.hide(change.hidden);
    if (change.hold !== undefined) driver.hold(change.hold, now);
    now += change.pause ?? 0;
    if (change.leave) driver.leave();
    if (change.takeover) driver.askTakeover();
    if (change.block !== undefined) driver.block(change.block);
    if (change.stick) driver.stick = change.stick;
    Object.assign(link, change.link);
    for (let i = 0; i < times; i += 1) turn();
  }
  const { phase, reason, other, rtt_ms } = driver;
  const speeds = sent.map(({ message }) => message.drive.speed);
  return { sent, speeds, phase, reason, other, rtt_ms, driving: driver.driving(now) };
}

const PUSHED: Change = { hold: true, stick: { x: -1, y: 1 } };
const HELD: readonly Step[] = [[4], [20, PUSHED]];

describe("the vectors that the terminal's driver has, too", () => {
  for (const { name, steps, expected, ...given } of driving.vectors)
    test(name, () => {
      const picture_ms = "picture_ms" in given ? given.picture_ms : undefined;
      const outcome = drive(steps as unknown as Step[], LIMITS, picture_ms);
      const commands: unknown[][] = [];
      for (const { session, message, lease_ms, behind, ...command } of outcome.sent) {
        const { speed, steering_angle } = message.drive;
        const kind: unknown[] = [session, speed, steering_angle, lease_ms];
        kind.push("takeover" in command, "ends" in command);
        if (picture_ms === undefined) assert.ok(!("frame" in command || "blind" in command));
        else kind.push(behind, "blind" in command);
        const last = commands.at(-1);
        if (last && JSON.stringify(last.slice(1)) === JSON.stringify(kind)) last[0] = Number(last[0]) + 1;
        else commands.push([1, ...kind]);
      }
      // JSON has no minus zero.
      assert.deepEqual(JSON.parse(JSON.stringify(commands)), expected.commands);
      assert.deepEqual([outcome.phase, outcome.rtt_ms ?? null], [expected.phase, expected.rtt_ms]);
      const ahead_us = outcome.sent.slice(-1).map(({ sent_us, at }) => sent_us - at * 1000);
      assert.equal(ahead_us.length, expected.ahead_us.length);
      // Half a microsecond is rounded.
      ahead_us.forEach((each, i) => assert.ok(Math.abs(each - expected.ahead_us[i]!) <= 1));
    });
});

describe("the stick", () => {
  const reach = { top_mps: 1, max_speed_mps: 2, max_steering_rad: 0.4 };
  for (const [x, y, speed_mps, steering_rad] of [
    [0, 0, 0, 0],
    [0, 1, 1, 0],
    [0, -0.5, -0.5, 0],
    // To the right is negative, as ROS counts angles.
    [1, 1, 1, -0.4],
    [-0.5, 0, 0, 0.2],
    [7, -9, -1, -0.4],
    [NaN, NaN, 0, 0],
  ] as const)
    test(`at ${x}, ${y} is a motion within the limits`, () => {
      const motion = meant({ x, y }, reach);
      assert.deepEqual([motion.speed_mps + 0, motion.steering_rad + 0], [speed_mps, steering_rad]);
      assert.ok(Math.abs(meant({ x, y }, { ...reach, top_mps: 99 }).speed_mps) <= reach.max_speed_mps);
    });

  test("is pushed by keys, a gamepad and a finger", () => {
    assert.deepEqual(keyed(["KeyW", "ArrowUp", "KeyA"]), { x: -1, y: 1 });
    assert.deepEqual(keyed(["KeyW", "KeyS", "Space"]), { x: 0, y: 0 });
    // A stick at rest is not quite at its centre; beyond, nothing jumps.
    const still = padded([0.1, -0.1, 0.05, 0]);
    assert.deepEqual([still.x + 0, still.y + 0], [0, 0]);
    const half = padded([0.12, -1, 0.56, 0]);
    assert.ok(Math.abs(half.x - 0.5) < 1e-9 && half.y === 1);
    assert.deepEqual([padded([]).x + 0, padded([]).y + 0], [0, 0]);
    assert.deepEqual(pointed(100, 0, 200), { x: 0, y: 1 });
    assert.deepEqual(pointed(900, 250, 200), { x: 1, y: -1 });
    // A key takes 0.4 s to the end of the way, and none back to the centre.
    assert.deepEqual(followed({ x: 0, y: 0.5 }, { x: 1, y: 1 }, 0.1), { x: 0.25, y: 0.75 });
    assert.deepEqual(followed({ x: -1, y: 1 }, { x: 1, y: 0 }, 0.1), { x: 0.25, y: 0 });
  });
});

describe("a hold", () => {
  test("begins at a standstill and moves once the car has answered", () => {
    const { sent, speeds, phase, rtt_ms, driving: who } = drive(HELD);
    assert.equal(phase, "driving");
    for (const [i, { session, by, lease_ms, seq }] of sent.entries())
      assert.deepEqual([session, by, lease_ms, seq], ["00000001", "ada", 350, i]);
    const still = speeds.indexOf(1);
    assert.ok(still >= 1 && still <= 5);
    assert.deepEqual(new Set(speeds.slice(still)), new Set([1]));
    assert.deepEqual(sent.at(-1)?.message, { drive: { speed: 1, steering_angle: 0.4 } });
    // There and back, without the time in the car; as the page sees it, in steps of 50 ms.
    assert.ok(rtt_ms !== undefined && rtt_ms >= 80 && rtt_ms <= 140);
    assert.deepEqual(who, { by: "ada", mine: true });
    // By the cloud's time, to within half of what the round trip is known to.
    for (const { sent_us, at } of sent.slice(still)) assert.ok(Math.abs(sent_us / 1e3 - at - AHEAD_MS) <= 25);
  });

  test("that ends lets the car stand; leaving gives it up, again in case a message is lost", () => {
    const held = drive([...HELD, [100, { hold: false }]]);
    assert.equal(held.phase, "holding");
    assert.deepEqual(held.speeds.slice(-101), [1, ...Array<number>(100).fill(0)]);
    assert.ok(!held.sent.some((command) => "ends" in command));
    const left = drive([...HELD, [10, { hold: false }], [10, { leave: true }]]);
    assert.equal(left.phase, "free");
    assert.deepEqual(
      left.sent.slice(-4).map(({ ends }) => ends),
      [undefined, true, true, true],
    );
    // The next hold is a session of its own.
    const again = drive([...HELD, [10, { leave: true }], [20, { hold: true }]]);
    assert.deepEqual([again.sent.at(-1)?.session, again.phase], ["00000002", "driving"]);
  });

  const sound: Change = { link: { silent: false, deaf: false, way: 40, outcome: "accepted" }, block: "" };
  for (const [change, reason] of [
    [{ link: { silent: true } }, "has not answered for"],
    [{ link: { deaf: true } }, "has not answered for"],
    [{ link: { way: 300 } }, "round trip takes"],
    [{ link: { outcome: "emergency_stop" } }, "stopped until somebody releases it"],
    [{ link: { outcome: "stopped" } }, "no command came in time"],
    [{ link: { outcome: "driven_by_another", driver: "ffff", by: "bob" } }, "bob has taken over"],
    [{ block: "This page is hidden" }, "This page is hidden"],
  ] as const)
    test(`is over until the viewer begins again: ${reason}, ${JSON.stringify(change)}`, () => {
      const over = drive([...HELD, [40, change]]);
      assert.equal(over.phase, "over");
      assert.match(over.reason, new RegExp(reason));
      assert.deepEqual(over.speeds.slice(-3), [0, 0, 0]);
      // The obstacle goes away, and the stick is still held: the car stands.
      const later = drive([...HELD, [40, change], [40, sound]]);
      assert.equal(later.phase, "over");
      assert.ok(later.speeds.slice(over.sent.length).every((speed) => speed === 0));
    });

  test("of a page that stood still drives on in no car, however long its leases", () => {
    const over = drive([...HELD, [10, { pause: 600 }]], { ...LIMITS, lease_ms: 10_000 });
    assert.match(over.reason, /stood still for 650 ms/);
    assert.deepEqual(over.speeds.slice(-11), [1, ...Array<number>(10).fill(0)]);
  });

  test("has the limits of the contract", () => {
    const { sent } = drive([...HELD, [60, { link: { silent: true } }]]);
    const moved = sent.filter(({ message }) => message.drive.speed !== 0);
    // The last sample before the silence was 42 ms old at most 100 ms before.
    const since_ms = moved.at(-1)!.at - (1e6 + 24 * TICK_MS);
    assert.ok(since_ms <= Math.min(DRIVE_MAX_AGE_MS, DRIVE_MAX_RTT_MS + 200));
  });

  for (const [before, reason] of [
    [{ link: { silent: true } }, "Nothing has been heard"],
    [{ block: "No connection" }, "No connection"],
  ] as const)
    test(`that cannot begin sends nothing: ${reason}`, () => {
      const over = drive([
        [4, before],
        [10, PUSHED],
      ]);
      assert.deepEqual([over.sent, over.phase], [[], "over"]);
      assert.match(over.reason, new RegExp(reason));
    });

  test("of a car that does not answer never moves it", () => {
    const over = drive([[4], [60, { ...PUSHED, link: { deaf: true } }]]);
    assert.equal(over.reason, "The car does not answer");
    assert.deepEqual(new Set(over.speeds), new Set([0]));
  });

  for (const [change, reason] of [
    [{ see: null }, "The picture is 520 ms old, at most 500 ms is allowed"],
    [{ hidden: true }, "This tab is hidden: nobody sees the picture"],
    [{ see: null, shown: false }, "No picture is on the screen"],
  ] as const)
    for (const let_go of [[], [10, { hold: false }]] as const)
      test(`by sight gives the car up at once: ${reason}, ${let_go.length === 0 ? "driving" : "held"}`, () => {
        const before = [[4, { see: 120 }], [20, PUSHED], ...(let_go.length === 0 ? [] : [let_go])] as Step[];
        const lost = drive([...before, [30, change]], LIMITS, 500);
        assert.deepEqual([lost.phase, lost.reason], [let_go.length === 0 ? "over" : "free", reason]);
        assert.deepEqual(
          lost.sent.slice(-4).map(({ ends }) => ends),
          [undefined, true, true, true],
        );
        // The picture is back, and the stick as it was: nothing is sent.
        const back = drive([...before, [30, change], [40, { see: 120, hidden: false }]], LIMITS, 500);
        assert.equal(back.sent.length, lost.sent.length);
        // Whoever drives blind, or a car without video, does not need it.
        const blind = drive([...before, [30, { ...change, blind: true }]], LIMITS, 500);
        for (const { phase } of [blind, drive([...before, [30, change]])])
          assert.equal(phase, let_go.length === 0 ? "driving" : "holding");
      });

  test("may be taken over when asked", () => {
    const refused: Step = [
      8,
      { ...PUSHED, link: { outcome: "driven_by_another", driver: "ffff", by: "bob" } },
    ];
    const over = drive([[4], refused]);
    assert.deepEqual([over.reason, over.other], ["bob drives this car", "bob"]);
    assert.deepEqual(new Set(over.speeds), new Set([0]));
    assert.ok(!over.sent.some((command) => "takeover" in command));
    assert.deepEqual(over.driving, { by: "bob", mine: false });
    const own: Partial<Link> = { outcome: "accepted", driver: null, by: "" };
    const taken = drive([
      [4],
      refused,
      [4, { hold: false }],
      [20, { takeover: true, hold: true, link: own }],
    ]);
    assert.equal(taken.phase, "driving");
    const session = taken.sent.filter((command) => command.session === "00000002");
    // Only until it has the car: two that insist would throw each other out for ever.
    assert.ok(session[0]?.takeover);
    assert.ok(!("takeover" in session.at(-1)!));
  });

  test("corrects a wrong clock by the car's answer", () => {
    const stale: Change = { ...PUSHED, link: { outcome: "stale" } };
    assert.equal(drive([[4], [2, stale], [20, { link: { outcome: "accepted" } }]]).phase, "driving");
    const forever = drive([[4], [30, stale]]);
    assert.match(forever.reason, /too old when it came/);
    assert.equal(new Set(forever.sent.map(({ session }) => session)).size, 3);
  });
});

describe("a dead man's switch whose release may not be seen is let go", () => {
  type Event_ = Readonly<Record<string, unknown>>;
  // A browser's events at `Inputs`; after each step, whether the switch is held.
  function hold(steps: readonly (readonly [type: string, event?: Event_])[]): boolean[] {
    class Node extends EventTarget {
      field: unknown;
      matches(selector: string): boolean {
        return selector.split(", ").includes(String(this.field));
      }
    }
    let shoulder: boolean | undefined;
    const gamepad = (): unknown => ({
      ...{ connected: true, mapping: "standard", axes: [0, -1] },
      buttons: Array(8).fill({ pressed: shoulder }),
    });
    const page = new EventTarget();
    const globals = {
      Element: Node,
      window: page,
      document: Object.assign(new EventTarget(), { hidden: false, hasFocus: () => true }),
      navigator: { getGamepads: () => (shoulder === undefined ? [] : [null, gamepad()]) },
    };
    for (const [name, value] of Object.entries(globals))
      Object.defineProperty(globalThis, name, { value, configurable: true });
    const node = (): HTMLElement => new Node() as unknown as HTMLElement;
    const hand = new Inputs(
      node(),
      node(),
      () => {},
      () => {},
    );
    return steps.map(([type, { pad, field, ...event } = {}]) => {
      if (pad !== undefined) shoulder = (pad as boolean | null) ?? undefined;
      const happens = Object.assign(new Event(type, { cancelable: true }), event);
      Object.defineProperty(happens, "target", { value: Object.assign(new Node(), { field }) });
      if (event.prevented) happens.preventDefault();
      page.dispatchEvent(happens);
      hand.read(0.05);
      return hand.held;
    });
  }

  const down = ["keydown", { code: "Space" }] as const;
  const again = ["keydown", { code: "Space", repeat: true }] as const;
  const text = { field: "textarea" };
  const pad = (pressed: boolean | null) => ["x", { pad: pressed }] as const;
  for (const [why, steps, held] of [
    ["released", [down, again, ["keyup", { code: "Space" }]], [true, true, false]],
    [
      "released in a text that has got the focus",
      [down, ["keyup", { code: "Space", ...text }]],
      [true, false],
    ],
    // The release of a key is not told while a menu is open, something is dragged, or a Mac's Cmd is held.
    ["a menu", [down, ["contextmenu"], again], [true, false, false]],
    ["no menu", [down, ["contextmenu", { prevented: true }]], [true, true]],
    ["something is dragged", [down, ["dragstart"], again], [true, false, false]],
    ["a text has the focus", [down, ["focusin", text], again], [true, false, false]],
    // The emergency stop ends a hold, and Space presses it.
    ["the stop has the focus", [down, ["focusin", { field: ".stop-press" }]], [true, false]],
    ["a press of the stop", [["keydown", { code: "Space", field: ".stop-press" }]], [false]],
    ["Cmd", [down, ["keydown", { code: "MetaLeft", metaKey: true }], again], [true, false, false]],
    // A key that is still held when the page gets the focus back is no press; a gamepad's button neither.
    ["a key still held", [down, ["blur"], again, down], [true, false, false, true]],
    [
      "a gamepad still held",
      [pad(false), pad(true), ["blur"], ["x"], pad(false), pad(true)],
      [false, true, false, false, false, true],
    ],
    ["a gamepad that was away", [pad(false), pad(true), pad(null), pad(true)], [false, true, false, false]],
  ] as const)
    test(why, () => assert.deepEqual(hold(steps), held));
});

test("clocks that contradict each other are the newest message", () => {
  // This computer slept for an hour after an answer.
  const clock = new CloudClock();
  clock.heard(1_000, 1_000);
  clock.answered(990, 1_000);
  clock.heard(3_601_100, 1_100);
  assert.equal(clock.offset_ms, 3_600_000);
});

for (const [names, by] of [
  [["\u00a0ada \u202elovelace\t"], "ada  lovelace"],
  [["\u200d", "bob"], "bob"],
  [["", "\x1b"], "somebody"],
  [["Z\u00fcrich \u{1f697}"], "Z\u00fcrich \u{1f697}"],
] as const)
  test(`a driver's name is one that the car takes: ${by}`, () => {
    wire.names.push([[...names], driverName(...names)]);
    assert.equal(driverName(...names), by);
  });

test("a confirmation is a press of its own", () => {
  const button = new EventTarget();
  let presses = 0;
  onPress(button as unknown as HTMLButtonElement, () => (presses += 1));
  for (const detail of [1, 2, 0]) button.dispatchEvent(Object.assign(new Event("click"), { detail }));
  assert.equal(presses, 2);
  // The browser presses the button unless this is prevented.
  const held = Object.assign(new Event("keydown", { cancelable: true }), { repeat: true });
  assert.equal(button.dispatchEvent(held), false);
});
