// The picture on the whole screen, with what a driver needs over it. The page itself goes full screen and hides the rest
// by its style, so that stick, keys and stop are what they were; a browser without the Fullscreen API, as an iPhone's,
// keeps its bars.

export class Screen {
  private readonly root = document.documentElement;

  constructor(private readonly changed: (full: boolean) => void) {
    document.addEventListener("fullscreenchange", () => !document.fullscreenElement && this.leave());
    window.addEventListener(
      "keydown",
      (event) => {
        if (!this.full || event.code !== "Escape") return;
        // It does not leave the car's view; who has the wheel leaves that, too.
        event.stopPropagation();
        this.leave();
      },
      { capture: true },
    );
  }

  get full(): boolean {
    return this.root.dataset.full === "true";
  }

  toggle(): void {
    if (this.full) this.leave();
    else this.enter();
  }

  leave(): void {
    if (!this.full) return;
    delete this.root.dataset.full;
    if (document.fullscreenElement) void document.exitFullscreen().catch(() => undefined);
    this.changed(false);
  }

  private enter(): void {
    this.root.dataset.full = "true";
    if ("requestFullscreen" in this.root)
      void this.root.requestFullscreen({ navigationUI: "hide" }).catch(() => undefined);
    this.changed(true);
  }
}
