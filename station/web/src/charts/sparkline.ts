// A small line of the last 30 seconds, without axes.

import { colour, onTheme } from "../base/theme";
import { WINDOW_S } from "../live/bounds";
import type { Ring } from "../live/ring";

const HOLE_S = 2.5;
const seen = new WeakSet<Element>();
const watcher = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    if (isIntersecting) seen.add(target);
    else seen.delete(target);
  }
});
let ink = "";
onTheme(() => (ink = colour("--accent")));

export class Sparkline {
  readonly node = document.createElement("canvas");
  private readonly context = this.node.getContext("2d");
  private size: readonly [number, number] = [0, 0];

  constructor() {
    this.node.className = "spark";
    this.node.setAttribute("aria-hidden", "true");
    watcher.observe(this.node);
    new ResizeObserver(([entry]) => {
      const box = entry?.contentRect;
      if (box) this.size = [box.width, box.height];
    }).observe(this.node);
  }

  draw(history: Ring, column: number | undefined, now: number): void {
    const { context, node } = this;
    const [width, height] = this.size;
    if (!context || column === undefined || width === 0 || !seen.has(node)) return;
    const ratio = Math.min(2, window.devicePixelRatio);
    if (node.width !== Math.round(width * ratio)) node.width = Math.round(width * ratio);
    if (node.height !== Math.round(height * ratio)) node.height = Math.round(height * ratio);
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const from = now - WINDOW_S;
    const times = history.column(0, from);
    const values = history.column(column, from);
    let [low, high] = [Infinity, -Infinity];
    for (const value of values) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
    if (!(low <= high)) return;
    // Noise of the last digit stays small.
    const span = Math.max(high - low, Math.abs(high) * 0.02, 1e-9);
    const middle = (low + high) / 2;
    context.beginPath();
    let before = -Infinity;
    for (let i = 0; i < times.length; i += 1) {
      const value = values[i]!;
      if (Number.isNaN(value)) continue;
      const x = ((times[i]! - from) / WINDOW_S) * width;
      const y = height / 2 - ((value - middle) / span) * (height - 4);
      if (times[i]! - before > HOLE_S) context.moveTo(x, y);
      else context.lineTo(x, y);
      before = times[i]!;
    }
    context.strokeStyle = ink;
    context.lineWidth = 1.3;
    context.lineJoin = "round";
    context.stroke();
  }
}
