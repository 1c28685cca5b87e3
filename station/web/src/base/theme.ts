// Dark or light, by the system's setting or the viewer's choice. Charts take their colours from here.

import { keep, kept } from "./kept";

const CHOICES = ["auto", "light", "dark"] as const;
type Choice = (typeof CHOICES)[number];

const listeners = new Set<() => void>();
let probe: HTMLElement | undefined;

export function startTheme(button: HTMLElement): void {
  let choice = stored();
  const apply = (): void => {
    if (choice === "auto") delete document.documentElement.dataset.theme;
    else document.documentElement.dataset.theme = choice;
    button.dataset.choice = choice;
    button.setAttribute("aria-label", `Theme: ${choice}`);
    button.title = `Theme: ${choice}`;
    for (const listener of listeners) listener();
  };
  button.addEventListener("click", () => {
    choice = CHOICES[(CHOICES.indexOf(choice) + 1) % CHOICES.length]!;
    keep("theme", choice);
    apply();
  });
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", apply);
  apply();
}

/** Call the listener after every change; returns what ends that. */
export function onTheme(listener: () => void): () => void {
  listeners.add(listener);
  return () => listeners.delete(listener);
}

/** A custom property's colour in a form that a canvas accepts. */
export function colour(property: string): string {
  if (!probe) {
    probe = document.createElement("span");
    probe.hidden = true;
    document.body.append(probe);
  }
  probe.style.color = `var(${property})`;
  return getComputedStyle(probe).color;
}

function stored(): Choice {
  const known = kept("theme");
  return CHOICES.find((choice) => choice === known) ?? "auto";
}
