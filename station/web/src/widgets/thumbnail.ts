// A thumbnail on a canvas. It is decoded from its bytes and never loaded by address, because the page's policy
// allows no pictures but its own. Its size is checked first: three kilobytes can claim a billion pixels.

import { el, setAttribute, Text } from "../base/dom";
import { age } from "../base/format";
import { bytes, type Claim } from "../live/attachments";

// The cars' thumbnails have 96 pixels; see device/iort_agent/lanes/attachment.py.
const MOST_PIXELS = 256;
// The marker of a frame of any coding; three markers of the range are tables (ITU T.81, table B.1).
const START_OF_FRAME = (marker: number): boolean =>
  marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker);
// Markers that may come before it: tables, the application's own and comments. All have a length; after a marker
// without one, a decoder would look for the next marker in another place.
const BEFORE_FRAME = (marker: number): boolean =>
  [0xc4, 0xdb, 0xdd, 0xfe].includes(marker) || (marker >= 0xe0 && marker <= 0xef);

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
    const bitmap = await bitmapOf(base64);
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
export async function bitmapOf(base64: string): Promise<ImageBitmap | undefined> {
  const jpeg = jpegOf(base64);
  return jpeg && createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })).catch(() => undefined);
}

/** Give a canvas the picture and its size. */
export function draw(canvas: HTMLCanvasElement, bitmap: ImageBitmap): void {
  [canvas.width, canvas.height] = [bitmap.width, bitmap.height];
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  bitmap.close();
}

/** The bytes of a JPEG with a small size in its header; undefined for anything else. */
export function jpegOf(base64: string): Uint8Array<ArrayBuffer> | undefined {
  let data: Uint8Array<ArrayBuffer>;
  try {
    data = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  } catch {
    return undefined;
  }
  if (data[0] !== 0xff || data[1] !== 0xd8) return undefined;
  // Segments have a marker of two bytes and a length that counts itself; the frame's segment has the size.
  const view = new DataView(data.buffer);
  for (let at = 2; at + 9 <= data.length && data[at] === 0xff; at += 2 + view.getUint16(at + 2)) {
    if (BEFORE_FRAME(data[at + 1]!)) continue;
    if (!START_OF_FRAME(data[at + 1]!)) return undefined;
    const [height, width] = [view.getUint16(at + 5), view.getUint16(at + 7)];
    return Math.min(height, width) > 0 && Math.max(height, width) <= MOST_PIXELS ? data : undefined;
  }
  return undefined;
}
