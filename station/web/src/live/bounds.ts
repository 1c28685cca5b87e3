// What is kept of the cars. Names and fields come from the network, so everything that they fill is bounded.

/** The range of gauges, tiles and cards, and of medians. */
export const WINDOW_S = 30;
export const MEDIAN_S = 10;
/** The longest window of a watched car's charts. */
export const DEEP_S = 1800;

// 30 s at 16 Hz, as the live lane carries at most 10. A full fleet keeps at most 64 MB of columns, a watched car as
// many columns again as its streams may have, of at most 12 MB a stream.
export const BOUNDS = {
  rows: 512,
  delays: 2048,
  columns: 8192,
  watched: 2048,
  cells: 1_500_000,
  robots: 1024,
  streams: 32,
  boots: 8,
  faults: 100,
  lines: 100,
  claims: 4,
} as const;

/** The most rows of a watched ring of `width` columns. */
export const deepRows = (width: number): number => Math.max(BOUNDS.rows, Math.floor(BOUNDS.cells / width));
