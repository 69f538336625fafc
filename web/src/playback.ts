/** Frames in time: requests to the worker, frames that are ready ahead, and the clock. */

import type { State } from "./state";
import type { Update } from "./update";
import source from "worker:decoder";
import type { Grown, Opened, Reply, Request } from "./worker";

/** Frames that are decoded ahead. */
const AHEAD = 3;

type Shown = Extract<Reply, { kind: "shown" }>;

export interface Events {
  opened(stream: Opened): void;
  /** Frames were added at the end. */
  grown?(stream: Grown): void;
  show(update: Update, position: number): void;
  failed(message: string): void;
  playing(playing: boolean): void;
}

export class Playback {
  position = -1;
  playing = false;
  speed = 1;
  /** Milliseconds for decoding each frame that was shown. */
  readonly decodeTimes: number[] = [];
  private readonly worker: Worker;
  private loops = true;
  private length = 0;
  fps = 30;
  private ready: Shown[] = [];
  private due = 0;
  /** The ticket of the last jump; frames with an older one are dropped. */
  private ticket = 0;
  private requested = -1;
  /** Where the jump leads. */
  private target = -1;
  /** Positions that are requested or ready, in the order in which they will be shown. */
  private queue: number[] = [];
  private jumping = false;
  private broken = false;
  private answers: ((state: State) => void)[] = [];

  constructor(private readonly events: Events) {
    this.worker = new Worker(URL.createObjectURL(new Blob([source], { type: "text/javascript" })));
    this.worker.onmessage = ({ data }: MessageEvent<Reply>) => this.receive(data);
    this.worker.onerror = ({ message }) => events.failed(message);
  }

  /** Open a stream, in place of the one before if there is one. */
  open(bytes: Uint8Array<ArrayBuffer>): void {
    this.send({ kind: "open", bytes }, [bytes.buffer]);
  }

  /** Add the bytes by which the stream has grown. */
  extend(bytes: Uint8Array<ArrayBuffer>): void {
    this.send({ kind: "extend", bytes }, [bytes.buffer]);
  }

  get last(): number {
    return this.length - 1;
  }

  /** Whether the first frame follows the last one. */
  get loop(): boolean {
    return this.loops;
  }

  set loop(loop: boolean) {
    this.loops = loop;
    if (!this.jumping) this.prefetch();
  }

  /** Whether a jump is under way. */
  get busy(): boolean {
    return this.jumping;
  }

  /** Position that is shown, or to which a jump leads. */
  get aim(): number {
    return this.jumping ? this.target : this.position;
  }

  /** Show a position as soon as it is decoded. */
  seek(position: number): void {
    const target = Math.max(0, Math.min(this.last, position));
    const underWay = target !== this.position && this.queue.includes(target) && !this.jumping && !this.broken;
    this.target = target;
    this.jumping = true;
    if (underWay) {
      while (this.jumping && this.ready.length > 0) this.accept(this.ready.shift()!);
      return;
    }
    this.drop();
    this.request(target, true);
  }

  play(playing: boolean): void {
    if (playing && this.atEnd) this.seek(0);
    this.playing = playing;
    this.due = performance.now();
    this.events.playing(playing);
  }

  /** Show the frame that is due at a time. */
  tick(now: number): void {
    if (!this.playing || this.jumping) return;
    const period = 1000 / (this.fps * this.speed);
    if (now - this.due > 5 * period) this.due = now; // decoding is too slow, or the page was hidden
    while (now >= this.due && this.ready.length > 0 && !this.atEnd) {
      this.due += period;
      this.present(this.ready.shift()!);
    }
    if (this.atEnd) this.play(false);
  }

  /** Return the state at a position, without showing it. */
  state(position: number): Promise<State> {
    this.send({ kind: "state", position });
    return new Promise((resolve) => this.answers.push(resolve));
  }

  dispose(): void {
    this.worker.terminate();
  }

  private get atEnd(): boolean {
    return this.position === this.last && !this.loops;
  }

  private present({ update, position, milliseconds }: Shown): void {
    this.position = position;
    this.queue.shift();
    this.decodeTimes.push(milliseconds);
    this.events.show(update, position);
    this.prefetch();
  }

  private prefetch(): void {
    while (!this.broken && this.queue.length < AHEAD) {
      if (this.requested === this.last && !this.loops) return;
      this.request(this.requested === this.last ? 0 : this.requested + 1, false);
    }
  }

  /** Forget the frames that were requested. */
  private drop(): void {
    this.ready = [];
    this.queue = [];
    this.ticket++;
    this.broken = false;
  }

  private request(position: number, fresh: boolean): void {
    this.requested = position;
    this.queue.push(position);
    this.send({ kind: "show", position, fresh, ticket: this.ticket });
  }

  private receive(reply: Reply): void {
    if (reply.kind === "opened") {
      this.drop();
      this.jumping = false;
      this.length = reply.frames.length;
      this.fps = reply.fps > 0 ? reply.fps : 30;
      try {
        this.events.opened(reply);
      } catch (error) {
        this.events.failed(error instanceof Error ? error.message : String(error));
      }
    } else if (reply.kind === "grown") {
      this.length = reply.frames.length;
      this.events.grown?.(reply);
    } else if (reply.kind === "state") {
      this.answers.shift()?.(reply.state);
    } else if (reply.kind === "failed" && reply.ticket === -1) {
      this.events.failed(reply.message);
    } else if (reply.ticket === this.ticket) {
      if (reply.kind === "failed") this.fail(reply.message);
      else this.accept(reply);
    }
  }

  private accept(shown: Shown): void {
    if (!this.jumping) {
      this.ready.push(shown);
      return;
    }
    if (shown.position === this.target) {
      this.jumping = false;
      this.due = performance.now() + 1000 / (this.fps * this.speed);
    }
    this.present(shown);
  }

  private fail(message: string): void {
    this.broken = true;
    this.jumping = false;
    this.play(false);
    this.events.failed(message);
  }

  private send(request: Request, transfer: Transferable[] = []): void {
    this.worker.postMessage(request, transfer);
  }
}
