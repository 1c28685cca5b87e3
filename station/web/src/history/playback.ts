// The slider through a range, and its playback, slower or faster than it was driven.

import { button, choices, el, setAttribute, Text } from "../base/dom";
import { when } from "../base/format";

const SPEEDS = [0.25, 0.5, 1, 2, 4, 8, 16];
const STEP_MS = 50;

export interface PlaybackEvents {
  /** The slider is on another row. */
  readonly point: (index: number) => void;
  /** The viewer has come to rest on a row. */
  readonly rest: () => void;
}

export class Playback {
  readonly node: HTMLElement;
  private readonly slider = el("input", {
    type: "range",
    min: "0",
    value: "0",
    class: "scrub",
    "aria-label": "Time within the range",
  });
  private readonly at = new Text("num scrub-at");
  private readonly button = button("Play", () => (this.playing ? this.pause() : this.start()), {
    class: "tool play",
  });
  private readonly speed = el(
    "select",
    { class: "tool speed", "aria-label": "Speed of the playback" },
    ...choices(SPEEDS.map((each) => [String(each), `${each}×`] as const)),
  );
  private times: readonly number[] = [];
  private timer: number | undefined;

  constructor(private readonly events: PlaybackEvents) {
    this.speed.value = "1";
    this.slider.addEventListener("input", () => events.point(this.index));
    this.slider.addEventListener("change", events.rest);
    this.node = el("div", { class: "scrubber" }, this.button, this.speed, this.slider, this.at.node);
  }

  get index(): number {
    return Number(this.slider.value);
  }

  /** The time of the row; NaN without rows. */
  get time(): number {
    return this.times[this.index] ?? NaN;
  }

  get playing(): boolean {
    return this.timer !== undefined;
  }

  set(times: readonly number[]): void {
    this.stop();
    this.times = times;
    this.slider.max = String(Math.max(0, times.length - 1));
  }

  show(index: number): void {
    const at = this.times[index];
    if (at === undefined) return;
    this.slider.value = String(index);
    const text = when(at, { fractionalSecondDigits: 1 });
    this.at.set(text);
    setAttribute(this.slider, "aria-valuetext", text);
  }

  stop(): void {
    window.clearInterval(this.timer);
    this.timer = undefined;
    this.button.textContent = "Play";
  }

  private pause(): void {
    this.stop();
    this.events.rest();
  }

  private start(): void {
    const { times } = this;
    let index = this.index;
    if (index >= times.length - 1) index = 0;
    let [at, before] = [times[index] ?? NaN, performance.now()];
    this.button.textContent = "Pause";
    this.timer = window.setInterval(() => {
      const now = performance.now();
      at += ((now - before) / 1000) * Number(this.speed.value);
      before = now;
      while (index < times.length - 1 && times[index + 1]! <= at) index += 1;
      this.events.point(index);
      if (index >= times.length - 1) this.pause();
    }, STEP_MS);
  }
}
