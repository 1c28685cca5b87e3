// "Open in Foxglove": the command that serves what is shown to Foxglove, Lichtblick and PlotJuggler, and links
// that open it there. The page itself serves none of them.

import { button, el, Text } from "../base/dom";

// `iort bridge` says the same, and listens there unless it is told otherwise.
const ADDRESS = "ws://127.0.0.1:8765/";
const SOURCE = new URLSearchParams({ ds: "foxglove-websocket", "ds.url": ADDRESS });

/** A button that shows how to open what `command` serves: the words after `iort bridge`. */
export function foxglove(command: () => string, label = "Open in Foxglove"): HTMLButtonElement {
  return button("Foxglove", () => show(`iort bridge ${command()}`), {
    "aria-label": label,
    "aria-haspopup": "dialog",
    title: label,
  });
}

function show(command: string): void {
  const said = new Text("note", "span", { role: "status" });
  const copy = async (): Promise<void> => {
    try {
      await navigator.clipboard.writeText(command);
      said.set("Copied.");
    } catch {
      // Without HTTPS on another computer, or without the right, a browser gives no clipboard.
      said.set("This browser does not let the page copy: select the command.");
    }
  };
  const close = button("Close", () => dialog.close());
  const dialog = el(
    "dialog",
    { class: "panel foxglove", "aria-label": "Open in Foxglove" },
    el("h3", {}, "Open in Foxglove"),
    el("p", {}, "1. Run this in a terminal:"),
    el("p", { class: "foxglove-command" }, el("code", {}, command)),
    el(
      "p",
      { class: "tools" },
      said.node,
      button("Copy", () => void copy()),
    ),
    el(
      "p",
      {},
      "2. Open ",
      el("a", { href: `foxglove://open?${SOURCE}` }, "Foxglove on this computer"),
      " or ",
      el(
        "a",
        { href: `https://app.foxglove.dev/~/view?${SOURCE}`, target: "_blank", rel: "noreferrer" },
        "app.foxglove.dev",
      ),
      `, which asks for an account. Lichtblick and PlotJuggler need none: their Foxglove WebSocket is ${ADDRESS}`,
    ),
    el("p", { class: "tools" }, close),
  );
  dialog.addEventListener("close", () => dialog.remove());
  document.body.append(dialog);
  dialog.showModal();
}
