// The picture of a car's camera, in its view: looked at by a button, or by taking the wheel. Its age is always over it.

import { now } from "../base/clock";
import type { Config, IceAnswer, SocketAnswer, VideoTermsEntry } from "../base/contract";
import { button, el, newName, panel, setAttribute, setText, Text } from "../base/dom";
import { age, capital, NOTHING, number } from "../base/format";
import { bitmapOf, draw } from "../base/jpeg";
import { Broker } from "../link/broker";
import { ask } from "../server/answers";
import { Figures } from "./figures";
import { topicsOf } from "./messages";
import { able, Peer } from "./peer";
import { Screen } from "./screen";
import { Sight, type Sighted, type Way } from "./sight";

const TICK_MS = 100;
/** Without an answer by then a session begins without relays. */
const SERVERS_MS = 3_000;
const FIGURES_MS = 1_000;
const MOST_PIXELS = 4096;
// Less of it is not on the screen.
const VISIBLE = 0.5;

type State = "off" | "waiting" | "live" | "late" | "frozen";
const SAID: Readonly<Record<State, string>> = {
  off: "",
  waiting: "There is no picture yet",
  live: "The picture is live",
  late: "The picture is late",
  frozen: "The picture is frozen",
};
const UNKNOWN = "How old the picture is is not known yet";
const WAYS: Readonly<Record<Way, string>> = { webrtc: "WebRTC", broker: "Small pictures over the broker" };

/** What the cars' cameras can show, by their shadows. */
interface Cameras {
  readonly of: (robot: string) => { readonly video: VideoTermsEntry | null } | undefined;
}

/** What there is while somebody looks. */
interface Looking {
  readonly sight: Sight;
  readonly broker: Broker;
  readonly timer: number;
  readonly figures: Figures;
}

export class PicturePanel {
  readonly node: HTMLElement;
  /** What a late picture means for who has the wheel; empty for who has not. */
  meaning = "";
  private readonly start = button("Look", () => this.open(), { class: "tool primary" });
  private readonly stop = button("Stop looking", () => this.close(), { class: "tool sight-end" });
  private readonly whole = button("Full screen", () => this.screen.toggle());
  private readonly video = el("video", {
    muted: "",
    playsinline: "",
    disablepictureinpicture: "",
    tabindex: "-1",
  });
  private readonly canvas = el("canvas", { role: "img" });
  private readonly age = new Text("sight-ms");
  // Too quick for a screen reader, which hears the state.
  private readonly words = el("p", { class: "sight-words", "aria-hidden": "true" });
  private readonly said = el("p", { class: "visually-hidden", role: "status" });
  private readonly line = el("p", { class: "note sight-line" });
  private readonly frame: HTMLElement;
  private readonly screen = new Screen((full) => {
    setText(this.whole, full ? "Leave full screen" : "Full screen");
    if (!full) this.reveal();
  });
  private robot: string | undefined;
  private looking: Looking | undefined;
  /** The viewer looks, though perhaps not now: a hidden tab asks for nothing. */
  private on = false;
  private visible = false;
  private counted_ms = -Infinity;
  private drawing = 0;

  constructor(
    private readonly config: Config,
    private readonly cameras: Cameras,
  ) {
    this.video.muted = true;
    const shown = el("p", { class: "sight-age" }, el("span", {}, "Age "), this.age.node);
    this.frame = el("div", { class: "sight-frame" }, this.video, this.canvas, shown, this.words);
    this.node = panel(
      "Picture",
      "sight",
      [this.whole, this.start, this.stop],
      this.said,
      this.frame,
      this.line,
    );
    this.node.hidden = true;
    // The newest is the last.
    new IntersectionObserver((seen) => (this.visible = seen.at(-1)!.intersectionRatio >= VISIBLE), {
      threshold: [VISIBLE],
    }).observe(this.frame);
    document.addEventListener("visibilitychange", () => this.attend());
    window.addEventListener("pagehide", () => this.rest());
    this.arranged();
  }

  /** Show this car from now on; none if undefined. */
  of(robot: string | undefined): void {
    if (robot === this.robot) return;
    this.close();
    this.robot = robot;
    this.show();
  }

  /** Called when what is known of the cars may be another. */
  show(): void {
    const may = this.config.answers && this.terms !== undefined;
    this.node.hidden = !may && !this.on;
  }

  /** The viewer looks. */
  open(): void {
    if (this.on || this.robot === undefined || !this.terms) return;
    this.on = true;
    this.frame.style.setProperty("--shape", `${this.terms.width} / ${this.terms.height}`);
    this.arranged();
    this.attend();
    this.draw();
  }

  /** The newest picture on the screen, with its age; undefined if none can be seen. */
  seen(): Sighted | undefined {
    return (this.visible || this.screen.full) && !document.hidden ? this.looking?.sight.sighted() : undefined;
  }

  /** Whether the viewer looks at pictures at all. */
  get looks(): boolean {
    return this.on;
  }

  /** Have the picture in sight. */
  reveal(): void {
    this.node.scrollIntoView({ block: innerWidth < innerHeight ? "start" : "nearest" });
  }

  private get terms(): VideoTermsEntry | null | undefined {
    const known = this.robot === undefined ? undefined : this.cameras.of(this.robot)?.video;
    return this.looking?.sight.terms ?? known ?? undefined;
  }

  private close(): void {
    this.on = false;
    cancelAnimationFrame(this.drawing);
    this.screen.leave();
    this.rest();
    this.arranged();
    this.show();
  }

  private arranged(): void {
    const { on } = this;
    [this.start.hidden, this.stop.hidden, this.whole.hidden] = [on, !on, !on];
    [this.frame.hidden, this.line.hidden] = [!on, !on];
    setAttribute(this.node, "data-on", String(on));
    setAttribute(this.node, "data-state", on ? "waiting" : "off");
    for (const name of ["data-way", "data-frame"]) this.node.removeAttribute(name);
    setText(this.line, "");
    setText(this.said, "");
  }

  /** Look while the tab is seen. */
  private attend(): void {
    if (!this.on || document.hidden) this.rest();
    else if (!this.looking) this.looking = this.look(this.robot!);
  }

  private look(robot: string): Looking {
    const sight: Sight = new Sight(topicsOf(this.config.namespace, robot), {
      send: (topic, message) => broker.send(topic, message),
      hear: (topic, heard) => broker.hear(topic, heard),
      servers: async () => (await ask<IceAnswer>("ice", {}, AbortSignal.timeout(SERVERS_MS))).ice_servers,
      peer: able() ? (servers, ends) => new Peer(servers, this.video, ends) : undefined,
      draw: async (jpeg) => {
        const bitmap = await bitmapOf(jpeg, MOST_PIXELS);
        // Another car may be looked at by now.
        if (bitmap && this.looking?.sight === sight) draw(this.canvas, bitmap);
        return bitmap !== undefined;
      },
      newName,
      now_ms: () => now() * 1000,
    });
    const broker: Broker = new Broker({
      address: () => ask<SocketAnswer>("socket", {}),
      topics: () => sight.heard(),
      message: (topic, payload) => sight.hear(topic, payload),
      state: (reason) => sight.connected(reason),
    });
    const label = `Picture of ${robot}'s camera`;
    for (const node of [this.video, this.canvas]) setAttribute(node, "aria-label", label);
    const timer = window.setInterval(() => sight.tick(), TICK_MS);
    return { sight, broker, timer, figures: new Figures() };
  }

  private rest(): void {
    const { looking } = this;
    this.looking = undefined;
    if (!looking) return;
    window.clearInterval(looking.timer);
    looking.sight.close();
    looking.broker.close();
  }

  /** With every frame of the screen: an age grows also if nothing comes. */
  private readonly draw = (): void => {
    this.drawing = requestAnimationFrame(this.draw);
    if (!this.looking) return;
    const { sight } = this.looking;
    const most_ms = this.terms?.max_age_ms ?? 0;
    const sighted = sight.sighted();
    const state = stateOf(sighted, most_ms);
    const { age_ms, still_ms = 0, way } = sighted ?? {};
    this.age.set(`${age_ms === undefined ? NOTHING : number(Math.min(age_ms, 99_999), 0)} ms`);
    const late = `${number(age_ms ?? 0, 0)} ms old, at most ${number(most_ms, 0)} ms`;
    const meaning = this.meaning ? `: ${this.meaning}` : "";
    const texts: Readonly<Record<State, string>> = {
      off: "",
      waiting: `${sighted ? UNKNOWN : sight.words}${sight.had ? meaning : ""}`,
      live: "",
      late: `Late, ${late}${meaning}`,
      frozen: `Frozen for ${age(still_ms / 1000)}${meaning}`,
    };
    setText(this.words, capital(texts[state]));
    setText(this.said, SAID[state]);
    setAttribute(this.node, "data-state", state);
    if (sighted) {
      setAttribute(this.node, "data-way", way!);
      setAttribute(this.node, "data-frame", String(sighted.number));
    }
    void this.count();
  };

  private async count(): Promise<void> {
    const at_ms = now() * 1000;
    const { looking } = this;
    if (!looking || at_ms - this.counted_ms < FIGURES_MS) return;
    this.counted_ms = at_ms;
    const way = looking.sight.sighted()?.way;
    const counts = await looking.sight.counts();
    if (!way || !counts || looking !== this.looking) return;
    const [width, height] =
      way === "webrtc"
        ? [this.video.videoWidth, this.video.videoHeight]
        : [this.canvas.width, this.canvas.height];
    const line = looking.figures.line(way, counts, at_ms, width, height);
    const { otherwise } = looking.sight;
    const why = way === "broker" && otherwise ? ` (WebRTC: ${otherwise})` : "";
    setText(this.line, `${WAYS[way]}${why}${line ? `: ${line}` : ""}`);
  }
}

/** A picture is late if newer ones come that are too old, and frozen if none come. */
function stateOf(sighted: Sighted | undefined, most_ms: number): State {
  if (sighted?.age_ms === undefined) return "waiting";
  if (sighted.age_ms <= most_ms) return "live";
  return sighted.still_ms > most_ms ? "frozen" : "late";
}
