/** Decoding outside the page's thread. */

import { Decoder } from "./decoder";
import type { State } from "./state";
import { type CameraFields, extend, openStream, type Stream } from "./stream";
import type { Update } from "./update";

export interface Opened {
  kind: "opened";
  cameras: CameraFields[];
  fps: number;
  metadata: Record<string, unknown>;
  frames: number[];
  damage: string | null;
}

export type Grown = { kind: "grown" } & Pick<Opened, "frames" | "damage">;

export type Request =
  | { kind: "open"; bytes: Uint8Array<ArrayBuffer> }
  | { kind: "extend"; bytes: Uint8Array<ArrayBuffer> }
  | { kind: "show"; position: number; fresh: boolean; ticket: number }
  | { kind: "state"; position: number };

export type Reply =
  | Opened
  | Grown
  | { kind: "shown"; position: number; ticket: number; milliseconds: number; update: Update }
  | { kind: "state"; state: State }
  | { kind: "failed"; ticket: number; message: string };

let stream: Stream | null = null;
let decoder: Decoder | null = null;

onmessage = ({ data }: MessageEvent<Request>) => {
  try {
    if (data.kind === "open") {
      const opened = openStream(data.bytes);
      decoder = new Decoder(opened);
      stream = opened;
      const { cameras, fps, metadata, damage } = stream;
      reply({ kind: "opened", cameras, fps, metadata, damage, frames: decoder.frames });
    } else if (data.kind === "extend") {
      decoder!.extend(extend(stream!, data.bytes));
      reply({ kind: "grown", frames: decoder!.frames, damage: stream!.damage });
    } else if (data.kind === "show") {
      const { position, fresh, ticket } = data;
      const start = performance.now();
      const update = decoder!.show(position, fresh);
      const milliseconds = performance.now() - start;
      const buffers = [update.rows.buffer, update.geometry.buffer, update.sh.buffer];
      reply({ kind: "shown", position, ticket, milliseconds, update }, buffers);
    } else {
      reply({ kind: "state", state: new Decoder(stream!).stateAt(data.position) });
    }
  } catch (error) {
    const ticket = data.kind === "show" ? data.ticket : -1;
    reply({ kind: "failed", ticket, message: error instanceof Error ? error.message : String(error) });
  }
};

function reply(message: Reply, transfer: Transferable[] = []): void {
  postMessage(message, { transfer });
}
