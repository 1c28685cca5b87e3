/** Seconds since the epoch, monotonic; the same clock in the page and in its worker. */
export const now = (): number => (performance.timeOrigin + performance.now()) / 1000;
