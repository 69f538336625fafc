/** Frames of a stream, in any order: forward by residuals, elsewhere from a keyframe or a state in memory. */

import { difference, everything } from "./rows";
import { applyResidual, bytesOf, type Change, copyOf, keyframe, ordered, type State } from "./state";
import { KEYFRAME, openArrays, openPacket, type PacketPlace, type Stream } from "./stream";
import type { Update } from "./update";

/** Memory for states to start from. */
const BUDGET = 256 * 2 ** 20;
/** Positions between these states. */
const SPACING = 16;

export class Decoder {
  /** Frame numbers in order; a position is an index into them. */
  readonly frames: number[] = [];
  /** For each position the packet that leads to it from the one before. */
  private readonly packets: PacketPlace[] = [];
  /** Keyframes by position, re-emitted ones included. */
  private readonly keyframes = new Map<number, PacketPlace>();
  private readonly saved = new Map<number, State>();
  private bytesSaved = 0;
  /** Rows that the last update displaced. */
  private displaced: Uint32Array = new Uint32Array(0);
  private state: State | null = null;
  private position = -1;

  constructor(private readonly stream: Stream) {
    if (stream.packets.length === 0) throw new Error("the stream has no frame yet");
    if (stream.packets[0].kind !== KEYFRAME) throw new Error("the stream has no keyframe to start from");
    this.extend(stream.packets);
  }

  /** Add packets that follow those before. */
  extend(packets: PacketPlace[]): void {
    for (const packet of packets) {
      if (packet.frame !== this.packets.at(-1)?.frame) {
        this.packets.push(packet);
        this.frames.push(packet.frame);
      }
      if (packet.kind === KEYFRAME) this.keyframes.set(this.packets.length - 1, packet);
    }
  }

  /** Decode a position; the update continues the last one, unless it is a reset, as it is if it shall be `fresh`. */
  show(position: number, fresh: boolean): Update {
    const next = !fresh && this.state !== null && position === this.position + 1;
    if (!next) this.enter(position);
    let change: Change | null = null;
    while (this.position < position) change = this.advance();
    const before = this.displaced;
    this.displaced = change?.moved ?? new Uint32Array(0);
    return next && change !== null ? difference(this.state!, change, before) : everything(this.state!, change);
  }

  /** Return the state at a position, in the order of the ids. */
  stateAt(position: number): State {
    this.show(position, true);
    return ordered(this.state!);
  }

  /** Go to the nearest state from which a position can be decoded with its displacements. */
  private enter(position: number): void {
    // Only a residual determines displacements, so a re-emitted keyframe of the position itself does not count.
    const latest = this.packets[position].kind === KEYFRAME ? position : position - 1;
    const before = (positions: Iterable<number>) => Math.max(-1, ...[...positions].filter((at) => at <= latest));
    const saved = before(this.saved.keys());
    const start = Math.max(saved, before(this.keyframes.keys()));
    if (this.state !== null && this.position <= latest && this.position >= start) return;
    this.state = saved === start ? copyOf(this.saved.get(saved)!) : this.loaded(start);
    this.position = start;
    this.save();
  }

  private advance(): Change | null {
    const position = this.position + 1;
    const packet = this.packets[position];
    let change: Change | null = null;
    if (packet.kind === KEYFRAME) {
      this.state = this.loaded(position);
    } else {
      const state = this.state!;
      this.state = null; // a failure leaves it half changed
      change = this.opened(packet, (arrays) => applyResidual(state, packet.frame, arrays));
      this.state = state;
    }
    this.position = position;
    this.save();
    return change;
  }

  private loaded(position: number): State {
    const packet = this.keyframes.get(position)!;
    return this.opened(packet, (arrays) => keyframe(packet.frame, arrays));
  }

  private opened<T>(packet: PacketPlace, decode: (arrays: ReturnType<typeof openArrays>) => T): T {
    try {
      return decode(openArrays(openPacket(this.stream.bytes, packet)));
    } catch (error) {
      throw new Error(`frame ${packet.frame}: ${error instanceof Error ? error.message : error}`);
    }
  }

  private save(): void {
    const { state, position } = this;
    if (state === null || this.saved.has(position)) return;
    if (position % SPACING !== 0 && !this.keyframes.has(position)) return;
    if (this.bytesSaved + bytesOf(state) > BUDGET) return;
    this.bytesSaved += bytesOf(state);
    this.saved.set(position, copyOf(state));
  }
}
