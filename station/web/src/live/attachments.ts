// Attachments: content that is too large for a message is a file (docs/how-to/files.md). The sample has five fields for
// it, among them the file's key and, for a picture, a thumbnail.

import { ATTACHMENT_PARTS, type Value } from "../base/contract";

export interface Claim {
  readonly key: string;
  readonly size: number;
  readonly contentType: string;
  /** A JPEG in base64; undefined if the content is not a picture, or if the car makes no thumbnails. */
  readonly thumbnail: string | undefined;
}

type Sample = Pick<ReadonlyMap<string, unknown>, "has" | "keys">;

/** The fields of bytes in a sample: those with all fields of an attachment. */
export function claimed(sample: Sample): string[] {
  const end = ".thumbnail";
  const found = [];
  for (const name of sample.keys()) {
    const field = name.endsWith(end) ? name.slice(0, -end.length) : "";
    if (field && ATTACHMENT_PARTS.every((part) => sample.has(`${field}.${part}`))) found.push(field);
  }
  return found;
}

export const partsOf = (field: string): string[] => ATTACHMENT_PARTS.map((part) => `${field}.${part}`);

/** A field's attachment; undefined if the car has left this content out. */
export function claim(field: string, value: (name: string) => Value | undefined): Claim | undefined {
  const [key, , size, contentType, thumbnail] = partsOf(field).map(value);
  if (typeof key !== "string") return undefined;
  return {
    key,
    size: typeof size === "number" ? size : NaN,
    contentType: typeof contentType === "string" ? contentType : "",
    thumbnail: typeof thumbnail === "string" ? thumbnail : undefined,
  };
}

/** A size: 3072 B, 1.2 MB. */
export function bytes(size: number): string {
  if (!Number.isFinite(size)) return "";
  const [unit, each] = size >= 1e6 ? ["MB", 1e6] : size >= 1e3 ? ["kB", 1e3] : ["B", 1];
  return `${(size / Number(each)).toFixed(each === 1 ? 0 : 1)} ${unit}`;
}
