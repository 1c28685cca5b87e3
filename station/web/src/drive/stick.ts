// The stick: where keys, a gamepad and a finger push it, and the motion that it means.

/** From -1 to 1: `x` to the right, `y` ahead. */
export interface Stick {
  readonly x: number;
  readonly y: number;
}

export interface Motion {
  readonly speed_mps: number;
  /** To the left, as ROS counts angles (REP 103). */
  readonly steering_rad: number;
}

/** How far a stick may go: the car's limits, and the viewer's own top speed. */
export interface Reach {
  readonly top_mps: number;
  readonly max_speed_mps: number;
  readonly max_steering_rad: number;
}

export const CENTRE: Stick = { x: 0, y: 0 };

// A gamepad's sticks rest up to this far from their centre.
const DEAD = 0.12;
// A key is all or nothing, so the stick follows it at this many lengths a second; back to the centre, it jumps.
const KEY_RATE = 2.5;
const PUSHES: Readonly<Record<string, Stick>> = {
  ArrowUp: { x: 0, y: 1 },
  KeyW: { x: 0, y: 1 },
  ArrowDown: { x: 0, y: -1 },
  KeyS: { x: 0, y: -1 },
  ArrowLeft: { x: -1, y: 0 },
  KeyA: { x: -1, y: 0 },
  ArrowRight: { x: 1, y: 0 },
  KeyD: { x: 1, y: 0 },
};

/** Whether a key, by its place on the keyboard, pushes the stick. */
export const pushes = (code: string): boolean => Object.hasOwn(PUSHES, code);

/** From -1 to 1; what is no number is at rest. */
const within = (value: number): number => (Number.isNaN(value) ? 0 : Math.min(1, Math.max(-1, value)));

/** Where a point is in a square, as a stick; `size` is its side, y goes down as on a screen. */
export function pointed(x: number, y: number, size: number): Stick {
  return { x: within((2 * x) / size - 1), y: within(1 - (2 * y) / size) };
}

/** Where the held keys push the stick. */
export function keyed(codes: Iterable<string>): Stick {
  let [x, y] = [0, 0];
  for (const code of codes) {
    x += PUSHES[code]?.x ?? 0;
    y += PUSHES[code]?.y ?? 0;
  }
  return { x: within(x), y: within(y) };
}

/** Where a gamepad's axes push it: ahead by the left stick, to the sides by the stick that is pushed further. */
export function padded(axes: readonly number[]): Stick {
  const side = (i: number): number => alive(axes[i] ?? 0);
  const [left, right] = [side(0), side(2)];
  return { x: Math.abs(right) > Math.abs(left) ? right : left, y: -side(1) || 0 };
}

/** An axis without its dead zone, from 0 at the zone's edge. */
function alive(value: number): number {
  const over = Math.abs(within(value)) - DEAD;
  return over <= 0 ? 0 : (Math.sign(value) * over) / (1 - DEAD);
}

/** The stick on its way to where keys push it, `seconds` later. */
export function followed(from: Stick, to: Stick, seconds: number): Stick {
  const most = KEY_RATE * Math.max(0, seconds);
  const one = (a: number, b: number): number => {
    // Never on the other side of the centre, nor further out than is asked for.
    const start = b === 0 || a * b < 0 ? 0 : a;
    return Math.abs(b) <= Math.abs(start) ? b : start + Math.sign(b) * Math.min(most, Math.abs(b - start));
  };
  return { x: one(from.x, to.x), y: one(from.y, to.y) };
}

/** The motion that a stick means: the whole way is the lower of both top speeds. */
export function meant({ x, y }: Stick, { top_mps, max_speed_mps, max_steering_rad }: Reach): Motion {
  const top = Math.max(0, Math.min(top_mps, max_speed_mps));
  // Not -0, which JSON has no sign for.
  return { speed_mps: within(y) * top || 0, steering_rad: -within(x) * max_steering_rad || 0 };
}
