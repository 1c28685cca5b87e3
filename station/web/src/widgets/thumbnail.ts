// A thumbnail on a canvas. It is decoded from its bytes and never loaded by address, because the page's policy
// allows no pictures but its own.

import { el, setAttribute, Text } from "../base/dom";
import { age } from "../base/format";
import { bitmapOf, draw } from "../base/jpeg";
import { bytes, type Claim } from "../live/attachments";

// The cars' thumbnails have 96 pixels; see device/iort_agent/lanes/attachment.py.
const MOST_PIXELS = 256;

export class Thumbnail {
  readonly node: HTMLElement;
  private readonly canvas = el("canvas", { role: "img" });
  private readonly state = new Text("picture-state");
  private readonly taken = new Text("picture-taken num");
  private readonly about = new Text("picture-about");
  private shown: string | undefined;

  constructor(
    private readonly label: string,
    field: string,
  ) {
    this.node = el(
      "figure",
      { class: "tile picture", "data-picture": field },
      el("figcaption", {}, el("span", { class: "tile-label" }, label), this.taken.node),
      el("div", { class: "picture-frame" }, this.canvas, this.state.node),
      this.about.node,
    );
    this.canvas.hidden = true;
    this.state.set("no picture yet");
  }

  /** Show an attachment; undefined keeps the last one, because the car does not keep every picture. */
  set(claim: Claim | undefined): void {
    if (!claim) return;
    const { key, size, contentType, thumbnail } = claim;
    this.about.set([contentType, bytes(size)].filter(Boolean).join(", "));
    setAttribute(this.node, "title", `iort files get: ${key}`);
    if (thumbnail === undefined)
      this.blank(contentType.startsWith("image/") ? "the car makes no thumbnails" : "no picture");
    else if (thumbnail !== this.shown) void this.decode(thumbnail);
  }

  /** Show the time of the content, in words. */
  when(text: string): void {
    this.taken.set(text);
  }

  /** Show the age of the content. */
  old(seconds: number): void {
    this.when(Number.isFinite(seconds) ? `${age(seconds)} old` : "");
  }

  private blank(state: string): void {
    this.shown = undefined;
    this.canvas.hidden = true;
    this.state.set(state);
  }

  private async decode(base64: string): Promise<void> {
    this.shown = base64;
    const bitmap = await thumbnailOf(base64);
    // A newer one has arrived meanwhile.
    if (this.shown !== base64) return bitmap?.close();
    if (!bitmap) return this.blank("a thumbnail that is no picture");
    draw(this.canvas, bitmap);
    this.canvas.hidden = false;
    this.state.set("");
    setAttribute(
      this.canvas,
      "aria-label",
      `${this.label}, ${this.canvas.width} by ${this.canvas.height} pixels`,
    );
  }
}

/** A small JPEG, decoded; undefined for anything else. */
export async function thumbnailOf(base64: string): Promise<ImageBitmap | undefined> {
  let data: Uint8Array<ArrayBuffer>;
  try {
    data = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  } catch {
    return undefined;
  }
  return bitmapOf(data, MOST_PIXELS);
}
