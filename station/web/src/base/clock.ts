/** Seconds since the epoch that only grow; the same in the page and in its worker. */
export const now = (): number => (performance.timeOrigin + performance.now()) / 1000;
