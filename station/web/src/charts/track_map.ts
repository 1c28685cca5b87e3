// The track's edges, from its centre line and widths.

import type { TrackMap } from "../base/contract";
import type { Track } from "./xy_chart";

/** The left and the right edge of a closed track; their first point is the last one, too. */
export function edges({ x_m, y_m, w_right_m, w_left_m }: TrackMap): [Track, Track] {
  const n = x_m.length;
  const edge = (side: (i: number) => number): Track => {
    const points = Array.from({ length: n + 1 }, (_, each) => {
      const [i, before, after] = [each % n, (each + n - 1) % n, (each + 1) % n];
      const [dx, dy] = [x_m[after]! - x_m[before]!, y_m[after]! - y_m[before]!];
      const away = side(i) / (Math.hypot(dx, dy) || 1);
      return [x_m[i]! - dy * away, y_m[i]! + dx * away] as const;
    });
    return { x: points.map(([x]) => x), y: points.map(([, y]) => y) };
  };
  return [edge((i) => w_left_m[i]!), edge((i) => -w_right_m[i]!)];
}
