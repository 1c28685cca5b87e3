// What is to be seen of incidents: an image of a camera at the edge, or a line of a field around it. They are asked for
// once somebody can see them, one after another: history and lists must not wait for them.

import type { IncidentPicture } from "../base/contract";
import { el } from "../base/dom";
import { number } from "../base/format";
import { draw } from "../base/jpeg";
import { ask } from "../server/answers";
import { thumbnailOf } from "./thumbnail";

const [WIDTH, HEIGHT, MARGIN] = [160, 90, 6];
const MOST_KNOWN = 500;
const SVG = "http://www.w3.org/2000/svg";

export class IncidentPictures {
  /** What the server has answered, by what was asked: a list is filled again whenever it changes. */
  private readonly known = new Map<string, IncidentPicture>();
  private readonly waiting = new Map<Element, () => Promise<void>>();
  private readonly seen: Element[] = [];
  private working = false;
  private ended = new AbortController();
  private readonly watcher = new IntersectionObserver((entries) => {
    for (const { target, isIntersecting } of entries) if (isIntersecting) this.seen.push(target);
    void this.work();
  });

  /** Forget the pictures of another list. */
  clear(): void {
    this.ended.abort();
    this.ended = new AbortController();
    this.watcher.disconnect();
    this.waiting.clear();
    if (this.known.size > MOST_KNOWN) this.known.clear();
  }

  /** The place of an incident's picture; `label` says which incident it is. */
  of(asked: Readonly<Record<string, string>>, label: string): HTMLElement {
    const node = el("figure", { class: "incident-picture" });
    const key = JSON.stringify(asked);
    const known = this.known.get(key);
    if (known) void show(node, known, label);
    else {
      const { signal } = this.ended;
      this.waiting.set(node, async () => {
        const answer = await ask<IncidentPicture>("incident_picture", asked, signal, "no-cache");
        this.known.set(key, answer);
        await show(node, answer, label);
      });
      this.watcher.observe(node);
    }
    return node;
  }

  private async work(): Promise<void> {
    if (this.working) return;
    this.working = true;
    for (let node = this.seen.shift(); node; node = this.seen.shift()) {
      const load = this.waiting.get(node);
      this.waiting.delete(node);
      this.watcher.unobserve(node);
      // A list is complete without pictures.
      await load?.().catch(() => node?.remove());
    }
    this.working = false;
  }
}

/** Fill the place; without a picture it goes. */
async function show(node: HTMLElement, picture: IncidentPicture, label: string): Promise<void> {
  const { jpeg, topic, after_s, field, times_s, values } = picture;
  const bitmap = jpeg ? await thumbnailOf(jpeg) : undefined;
  if (bitmap) {
    const when = `${Math.abs(after_s).toFixed(2)} s ${after_s < 0 ? "before" : "after"}`;
    const canvas = el("canvas", { role: "img", "aria-label": `${label}: ${topic}, ${when} the edge` });
    draw(canvas, bitmap);
    node.replaceChildren(canvas, el("figcaption", { "aria-hidden": "true", title: topic }, topic));
  } else if (values.length > 1) {
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const about = `${field} from ${number(low)} to ${number(high)} around the edge`;
    const caption = el("figcaption", { "aria-hidden": "true", title: about }, field);
    node.replaceChildren(line(times_s, values, `${label}: ${about}`), caption);
  } else node.remove();
}

/** The values over time, and an upright line at the edge. */
export function path(times_s: readonly number[], values: readonly number[]): { line: string; edge: number } {
  const [from, to] = [Math.min(times_s[0]!, 0), Math.max(times_s.at(-1)!, 0)];
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const x = (time: number): number => MARGIN + ((time - from) / (to - from || 1)) * (WIDTH - 2 * MARGIN);
  // What does not change is in the middle.
  const y = (value: number): number =>
    MARGIN + (high > low ? (high - value) / (high - low) : 0.5) * (HEIGHT - 2 * MARGIN);
  const points = times_s.map((time, i) => `${x(time).toFixed(1)} ${y(values[i]!).toFixed(1)}`);
  return { line: `M${points.join("L")}`, edge: x(0) };
}

function line(times_s: readonly number[], values: readonly number[], label: string): SVGElement {
  const drawn = path(times_s, values);
  const svg = shape("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": label });
  svg.append(
    shape("line", {
      class: "edge",
      x1: `${drawn.edge}`,
      x2: `${drawn.edge}`,
      y1: "0",
      y2: `${HEIGHT}`,
    }),
    shape("path", { d: drawn.line }),
  );
  return svg;
}

function shape(tag: "svg" | "line" | "path", attributes: Readonly<Record<string, string>>): SVGElement {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  return node;
}
