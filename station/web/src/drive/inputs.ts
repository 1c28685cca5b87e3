// What a hand does: keys, a gamepad, a finger or the mouse. Space, a shoulder button, the button on the page or the
// pressed mouse is the dead-man's switch. Whatever is held is let go when its end may not be seen: without the focus, in a
// menu, while something is dragged, in a text field. It must then be pressed again.

import { CENTRE, followed, keyed, padded, pointed, pushes, type Stick } from "./stick";

// L1 and R1 of the standard mapping.
const SHOULDERS = [4, 5] as const;
// What takes the keys itself: the emergency stop must be pressed by Space, too.
const TYPED = "input:not([type=range]), select, textarea, .stop-press";

export class Inputs {
  private readonly keys = new Set<string>();
  private readonly pointers = new Set<number>();
  private space = false;
  private shoulder = false;
  /** Whether the gamepad's button was seen let go, since the page has the focus. */
  private fresh = false;
  private dragged: { readonly id: number; readonly mouse: boolean } | undefined;
  private byKeys = CENTRE;
  private byPad = CENTRE;
  private byPointer = CENTRE;
  private readonly ears = new AbortController();

  /** `changed` is called when the dead-man's switch may be another; `leave` for Escape. */
  constructor(
    private readonly pad: HTMLElement,
    button: HTMLElement,
    private readonly changed: () => void,
    leave: () => void,
  ) {
    const { signal } = this.ears;
    const early = { signal, capture: true };
    window.addEventListener("keydown", (event) => this.key(event, true, leave), early);
    window.addEventListener("keyup", (event) => this.key(event, false, leave), early);
    document.addEventListener("visibilitychange", () => this.release(), { signal });
    for (const end of ["blur", "pagehide", "dragstart"] as const)
      window.addEventListener(end, () => this.release(), { signal });
    // A finger that rests on the button asks for a menu, too, and gets none.
    window.addEventListener("contextmenu", (event) => event.defaultPrevented || this.release(), { signal });
    window.addEventListener("focusin", (event) => typed(event) && this.release(), { signal });
    for (const node of [pad, button])
      node.addEventListener("contextmenu", (event) => event.preventDefault(), { signal });
    button.addEventListener(
      "pointerdown",
      (event) => {
        button.setPointerCapture(event.pointerId);
        this.pointers.add(event.pointerId);
        changed();
      },
      { signal },
    );
    pad.addEventListener(
      "pointerdown",
      (event) => {
        if (this.dragged) return;
        pad.setPointerCapture(event.pointerId);
        this.dragged = { id: event.pointerId, mouse: event.pointerType === "mouse" };
        this.drag(event);
        changed();
      },
      { signal },
    );
    pad.addEventListener("pointermove", (event) => event.pointerId === this.dragged?.id && this.drag(event), {
      signal,
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"] as const) {
      button.addEventListener(end, (event) => this.lift(event.pointerId), { signal });
      pad.addEventListener(end, (event) => this.lift(event.pointerId), { signal });
    }
  }

  /** Whether the dead-man's switch is held. A mouse has one hand, so its press on the stick is both. */
  get held(): boolean {
    return this.space || this.shoulder || this.pointers.size > 0 || this.dragged?.mouse === true;
  }

  /** Where the stick is now, `seconds` after the last call. */
  read(seconds: number): Stick {
    this.byKeys = followed(this.byKeys, keyed(this.keys), seconds);
    // No browser shows gamepads to a page at http:// on another computer.
    const gamepads = "getGamepads" in navigator ? navigator.getGamepads() : [];
    const gamepad = gamepads.find((each) => each?.connected && each.mapping === "standard") ?? undefined;
    this.byPad = gamepad ? padded(gamepad.axes) : CENTRE;
    const pressed = SHOULDERS.some((i) => gamepad?.buttons[i]?.pressed);
    this.fresh = gamepad !== undefined && !document.hidden && document.hasFocus() && (this.fresh || !pressed);
    this.shoulder = this.fresh && pressed;
    if (this.dragged) return this.byPointer;
    return this.byKeys.x !== 0 || this.byKeys.y !== 0 || this.keys.size > 0 ? this.byKeys : this.byPad;
  }

  end(): void {
    this.release();
    this.ears.abort();
  }

  private release(): void {
    this.keys.clear();
    this.pointers.clear();
    [this.space, this.shoulder, this.fresh, this.dragged] = [false, false, false, undefined];
    this.byKeys = this.byPointer = CENTRE;
    this.changed();
  }

  private key(event: KeyboardEvent, down: boolean, leave: () => void): void {
    // A Mac does not tell the release of a key while this one is held.
    if (down && event.metaKey) this.release();
    if (down && (typed(event) || event.ctrlKey || event.metaKey || event.altKey)) return;
    if (event.code === "Escape" && down) leave();
    else if (event.code === "Space") this.space = down && (this.space || !event.repeat);
    else if (!pushes(event.code)) return;
    else if (down) this.keys.add(event.code);
    else this.keys.delete(event.code);
    if (!typed(event)) {
      // Neither another car, nor a press on the button that has the focus.
      event.preventDefault();
      event.stopPropagation();
    }
    this.changed();
  }

  private drag(event: PointerEvent): void {
    const { left, top, width } = this.pad.getBoundingClientRect();
    this.byPointer = pointed(event.clientX - left, event.clientY - top, width);
  }

  private lift(id: number): void {
    this.pointers.delete(id);
    if (this.dragged?.id === id) [this.dragged, this.byPointer] = [undefined, CENTRE];
    this.changed();
  }
}

const typed = ({ target }: Event): boolean => target instanceof Element && target.matches(TYPED);
