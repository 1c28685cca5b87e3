// What the viewer chose, kept in this browser. Without storage, a choice lasts until the page is closed.

export function keep(name: string, value: string): void {
  try {
    localStorage.setItem(`iort.${name}`, value);
  } catch {
    // As said above.
  }
}

export function kept(name: string): string | undefined {
  try {
    return localStorage.getItem(`iort.${name}`) ?? undefined;
  } catch {
    return undefined;
  }
}
