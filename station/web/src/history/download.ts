// Saves a range as a file of one of the server's formats.

import { button, el, Text } from "../base/dom";
import { bytes } from "../live/attachments";
import { download, Latest } from "../server/answers";

const FORMATS = { csv: "CSV", parquet: "Parquet", mcap: "MCAP" } as const;

export class Download {
  readonly node: HTMLElement;
  private readonly note = new Text("note", "span", { role: "status" });
  private readonly loading = new Latest();

  /** `asked` gives the parameters of the request. */
  constructor(private readonly asked: () => Readonly<Record<string, string>>) {
    const buttons = Object.entries(FORMATS).map(([format, label]) => {
      const title = `Every field and sample of the range, as ${label}`;
      return button(label, () => void this.save(format), { title });
    });
    this.node = el("p", { class: "download" }, "Download ", ...buttons, this.note.node);
  }

  private async save(format: string): Promise<void> {
    this.note.set("Reading the samples …");
    const received = (size: number): void => this.note.set(`${bytes(size)} …`);
    await this.loading.run(
      async (signal) => {
        const { content, name } = await download(`history.${format}`, this.asked(), received, signal);
        const address = URL.createObjectURL(content);
        el("a", { href: address, download: name }).click();
        // The browser takes its own hold of the content when it begins to save it.
        window.setTimeout(() => URL.revokeObjectURL(address), 60_000);
        this.note.set(`${name}, ${bytes(content.size)}`);
      },
      (reason) => this.note.set(reason),
    );
  }
}
