// Saves a range as a file of one of the server's formats.

import { el, Text } from "../base/dom";
import { bytes } from "../live/attachments";
import { AnswerError, download } from "../server/answers";

const FORMATS = { csv: "CSV", parquet: "Parquet", mcap: "MCAP" } as const;

export class Download {
  readonly node: HTMLElement;
  private readonly note = new Text("note", "span", { role: "status" });
  private loading: AbortController | undefined;

  /** `asked` gives the parameters of the request. */
  constructor(private readonly asked: () => Readonly<Record<string, string>>) {
    const buttons = Object.entries(FORMATS).map(([format, label]) => {
      const button = el(
        "button",
        { type: "button", class: "tool", title: `Every field and sample of the range, as ${label}` },
        label,
      );
      button.addEventListener("click", () => void this.save(format));
      return button;
    });
    this.node = el("p", { class: "download" }, "Download ", ...buttons, this.note.node);
  }

  private async save(format: string): Promise<void> {
    this.loading?.abort();
    const loading = new AbortController();
    this.loading = loading;
    this.note.set("Reading the samples …");
    try {
      const { content, name } = await download(
        `history.${format}`,
        this.asked(),
        (size) => this.note.set(`${bytes(size)} …`),
        loading.signal,
      );
      const address = URL.createObjectURL(content);
      el("a", { href: address, download: name }).click();
      // The browser takes its own hold of the content when it begins to save it.
      window.setTimeout(() => URL.revokeObjectURL(address), 60_000);
      this.note.set(`${name}, ${bytes(content.size)}`);
    } catch (error) {
      if (!loading.signal.aborted)
        this.note.set(error instanceof AnswerError ? error.message : String(error));
    }
  }
}
