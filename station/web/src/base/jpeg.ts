// A JPEG's size, before it is decoded: three kilobytes can claim a billion pixels.

// The marker of a frame of any coding; three markers of the range are tables (ITU T.81, table B.1).
const START_OF_FRAME = (marker: number): boolean =>
  marker >= 0xc0 && marker <= 0xcf && ![0xc4, 0xc8, 0xcc].includes(marker);
// Markers that may come before it: tables, the application's own and comments. All have a length; after a marker
// without one, a decoder would look for the next marker in another place.
const BEFORE_FRAME = (marker: number): boolean =>
  [0xc4, 0xdb, 0xdd, 0xfe].includes(marker) || (marker >= 0xe0 && marker <= 0xef);

/** Decode a JPEG whose header says at most this many pixels a side; undefined for anything else. */
export async function bitmapOf(
  data: Uint8Array<ArrayBuffer>,
  mostPixels: number,
): Promise<ImageBitmap | undefined> {
  return fits(data, mostPixels)
    ? createImageBitmap(new Blob([data], { type: "image/jpeg" })).catch(() => undefined)
    : undefined;
}

/** Give a canvas the picture and its size. */
export function draw(canvas: HTMLCanvasElement, bitmap: ImageBitmap): void {
  // A canvas is cleared by its size, also by the same one.
  if (canvas.width !== bitmap.width) canvas.width = bitmap.width;
  if (canvas.height !== bitmap.height) canvas.height = bitmap.height;
  canvas.getContext("2d")?.drawImage(bitmap, 0, 0);
  bitmap.close();
}

/** Whether this is a JPEG with a size in its header, of at most so many pixels a side. */
export function fits(data: Uint8Array<ArrayBuffer>, mostPixels: number): boolean {
  if (data[0] !== 0xff || data[1] !== 0xd8) return false;
  // Segments have a marker of two bytes and a length that counts itself; the frame's segment has the size.
  const view = new DataView(data.buffer, data.byteOffset, data.byteLength);
  for (let at = 2; at + 9 <= data.length && data[at] === 0xff; at += 2 + view.getUint16(at + 2)) {
    if (BEFORE_FRAME(data[at + 1]!)) continue;
    if (!START_OF_FRAME(data[at + 1]!)) return false;
    const [height, width] = [view.getUint16(at + 5), view.getUint16(at + 7)];
    return Math.min(height, width) > 0 && Math.max(height, width) <= mostPixels;
  }
  return false;
}
