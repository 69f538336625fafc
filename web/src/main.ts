/** The page: its controls, and what connects playback, view and drawing. */

import { positionOf } from "./cameras";
import { CONFIDENCE_GRADIENT } from "./colors";
import { Playback } from "./playback";
import { type Mode, MODES, Splats } from "./splats";
import { type CameraFields, download } from "./stream";
import { View } from "./view";
import type { Opened } from "./worker";

declare function embedded(id: string): Uint8Array<ArrayBuffer>;

const PLAY = "M7 4v16l13-8z";
const PAUSE = "M6 4h4v16H6zM14 4h4v16h-4z";
/** The controls fade after so many milliseconds without input while the clip plays. */
const IDLE = 3000;

const element = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;
const canvas = element<HTMLCanvasElement>("canvas");
const slider = element<HTMLInputElement>("slider");
const cameraList = element<HTMLSelectElement>("camera");
const speedList = element<HTMLSelectElement>("speed");
const modeButtons = [...document.querySelectorAll<HTMLButtonElement>("[data-mode]")];

function say(text: string): void {
  element("message").textContent = text;
  element("message").hidden = false;
}

function sayFailure(error: unknown): void {
  say(`This page could not start: ${error instanceof Error ? error.message : error}.`);
}

async function streamBytes(): Promise<Uint8Array<ArrayBuffer>> {
  const address = element("stream").dataset.address;
  return address === undefined ? embedded("stream") : download(address);
}

/** Scale of the page's units: the rig spans four, as Spark's thresholds are absolute. */
function unitOf(cameras: CameraFields[]): number {
  const positions = cameras.map(positionOf);
  const span = Math.max(...positions.map((position) => position.distanceTo(positions[0])));
  return 4 / (span || positions[0].length() || 4);
}

class Player {
  readonly playback: Playback;
  splats!: Splats;
  private view!: View;
  private cameras: CameraFields[] = [];
  private frames: number[] = [];
  /** What the address asks for: #frame=12&camera=left&mode=motion&pause */
  private readonly wishes = new URLSearchParams(location.hash.slice(1));
  private started = false;
  /** Motion that is fully saturated, as a fraction of the image's width per frame. */
  private motionScale = 0;
  /** Mode of the legend. */
  private legend: Mode = "color";
  private lastInput = 0;

  constructor(bytes: Uint8Array<ArrayBuffer>) {
    this.playback = new Playback(bytes, {
      opened: (stream) => this.open(stream),
      show: (update, position) => {
        this.splats.apply(update);
        slider.value = String(position);
        this.count();
        if (!this.started) this.start(update.confidence);
      },
      failed: (message) => {
        if (this.started) say(`This stream is damaged: ${message}. The frames before that play.`);
        else sayFailure(message);
      },
      playing: (playing) => {
        element("play").ariaLabel = playing ? "Pause" : "Play";
        element("play").querySelector("path")!.setAttribute("d", playing ? PAUSE : PLAY);
      },
    });
  }

  /** Whether the page shows a frame completely. */
  get settled(): boolean {
    return this.started && !this.playback.busy && this.splats.settled;
  }

  private open(stream: Opened): void {
    ({ cameras: this.cameras, frames: this.frames } = stream);
    if (stream.damage !== null) say(`This stream is damaged: ${stream.damage}. The frames before that play.`);
    const unit = unitOf(this.cameras);
    const metadata = stream.metadata as { motion_scale?: number; default_rig?: boolean };
    this.motionScale = metadata.motion_scale ?? 0.03;
    this.splats = new Splats(canvas, stream.metadata, unit);
    this.view = new View(this.cameras, unit, canvas, () => this.followView());
    if (metadata.default_rig === true) this.bound(); // no recorded views to stay near
    cameraList.replaceChildren(...this.cameras.map(({ name }, i) => new Option(name, String(i))));
    slider.max = String(this.frames.length - 1);
    element("player").classList.toggle("still", this.frames.length === 1);
    this.playback.seek(0);
  }

  /** Begin with the first frame that is shown. */
  private start(confidence: boolean): void {
    this.started = true;
    modeButtons.find(({ dataset }) => dataset.mode === "confidence")!.hidden = !confidence;
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    const wished = this.cameras.findIndex(({ name }) => name === this.wishes.get("camera"));
    this.selectCamera(Math.max(0, wished));
    if (this.wishes.has("frame")) this.playback.seek(this.frames.indexOf(Number(this.wishes.get("frame"))));
    else this.leaveFirst();
    this.selectMode(MODES.find((mode) => mode === this.wishes.get("mode")) ?? "color");
    this.listen();
    this.lastInput = performance.now();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.playback.play(!still && !this.wishes.has("pause") && this.frames.length > 1);
    requestAnimationFrame((now) => this.tick(now));
  }

  private tick(now: number): void {
    this.playback.tick(now);
    this.view.update();
    this.splats.draw(this.view.camera);
    if (this.legend !== this.splats.shown) this.showLegend(this.splats.shown);
    element("player").classList.toggle("idle", this.playback.playing && now - this.lastInput > IDLE);
    requestAnimationFrame((next) => this.tick(next));
  }

  private count(): void {
    const { position, last } = this.playback;
    element("count").textContent = `${this.frames[position]} / ${this.frames[last]}`;
    element("player").classList.toggle("first", position === 0);
  }

  private followView(): void {
    this.splats.setView(this.view.camera, this.view.tangent(this.motionScale));
  }

  private resize(): void {
    const { clientWidth, clientHeight } = canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.splats.resize(clientWidth, clientHeight, Math.min(devicePixelRatio, 2));
    this.view.resize(clientWidth, clientHeight);
    this.splats.draw(this.view.camera);
  }

  private selectCamera(index: number): void {
    cameraList.value = String(index);
    this.view.select(index, (camera) => this.splats.medianDepth(camera));
  }

  private selectMode(mode: Mode): void {
    this.splats.setMode(mode);
    this.followView();
    for (const button of modeButtons) button.ariaPressed = String(button.dataset.mode === mode);
    if (mode !== "color") this.leaveFirst();
  }

  /** Go from the first frame, which has no motion and whose confidence is not learned, to the next. */
  private leaveFirst(): void {
    const { position, last, busy } = this.playback;
    if (position === 0 && last > 0 && !busy) this.playback.seek(1);
  }

  private showLegend(mode: Mode): void {
    this.legend = mode;
    const legend = element("legend");
    legend.hidden = mode === "color";
    legend.replaceChildren(element<HTMLTemplateElement>(`legend-${mode}`)?.content.cloneNode(true) ?? "");
    const ramp = legend.querySelector<HTMLElement>(".ramp");
    if (ramp) ramp.style.backgroundImage = `linear-gradient(to top, ${CONFIDENCE_GRADIENT})`;
    const scale = legend.querySelector(".scale");
    if (scale) scale.textContent = (100 * this.motionScale).toPrecision(2);
  }

  private selectSpeed(index: number): void {
    const { options } = speedList;
    speedList.selectedIndex = Math.max(0, Math.min(options.length - 1, index));
    this.playback.speed = Number(speedList.value);
  }

  private step(by: number): void {
    this.playback.play(false);
    this.playback.seek(this.playback.position + by);
  }

  private toggle(): void {
    this.playback.play(!this.playback.playing);
  }

  private repeat(): void {
    this.playback.loop = !this.playback.loop;
    element("loop").ariaPressed = String(this.playback.loop);
  }

  private bound(): void {
    this.view.bounded = !this.view.bounded;
    element("bound").ariaPressed = String(this.view.bounded);
  }

  private fullScreen(): void {
    if (document.fullscreenElement) void document.exitFullscreen();
    else void element("player").requestFullscreen().catch(() => {});
  }

  private listen(): void {
    const help = element<HTMLDialogElement>("help");
    const on = (id: string, action: () => void) => element(id).addEventListener("click", action);
    on("play", () => this.toggle());
    on("loop", () => this.repeat());
    on("bound", () => this.bound());
    on("full", () => this.fullScreen());
    on("about", () => help.showModal());
    on("close", () => help.close());
    element("full").hidden = !document.fullscreenEnabled;
    slider.addEventListener("input", () => {
      this.playback.play(false);
      this.playback.seek(Number(slider.value));
    });
    cameraList.addEventListener("change", () => this.selectCamera(Number(cameraList.value)));
    speedList.addEventListener("change", () => this.selectSpeed(speedList.selectedIndex));
    for (const button of modeButtons) {
      button.addEventListener("click", () => this.selectMode(button.dataset.mode as Mode));
    }
    for (const event of ["pointermove", "pointerdown", "keydown"]) {
      addEventListener(event, () => (this.lastInput = performance.now()), { capture: true });
    }
    addEventListener("keydown", (event) => this.key(event));
  }

  private key(event: KeyboardEvent): void {
    const { key, target } = event;
    const onControl = target instanceof HTMLSelectElement || (target instanceof HTMLButtonElement && key === " ");
    if (onControl || event.ctrlKey || event.altKey || event.metaKey || element<HTMLDialogElement>("help").open) return;
    const camera = Number(cameraList.value);
    const angle = Math.PI / 36;
    const orbit: Record<string, () => void> = {
      ArrowLeft: () => this.view.turn(-angle, 0),
      ArrowRight: () => this.view.turn(angle, 0),
      ArrowUp: () => this.view.turn(0, angle),
      ArrowDown: () => this.view.turn(0, -angle),
    };
    const actions: Record<string, () => void> = {
      " ": () => this.toggle(),
      k: () => this.toggle(),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
      "+": () => this.view.zoom(1 / 1.1),
      "-": () => this.view.zoom(1.1),
      "1": () => this.selectMode("color"),
      "2": () => this.selectMode("motion"),
      "3": () => this.selectMode("confidence"),
      c: () => this.selectCamera((camera + 1) % this.cameras.length),
      r: () => this.selectCamera(camera),
      "<": () => this.selectSpeed(speedList.selectedIndex - 1),
      ">": () => this.selectSpeed(speedList.selectedIndex + 1),
      l: () => this.repeat(),
      b: () => this.bound(),
      f: () => this.fullScreen(),
      "?": () => element<HTMLDialogElement>("help").showModal(),
    };
    const action = (event.shiftKey && orbit[key]) || actions[key.length === 1 ? key.toLowerCase() : key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  }
}

// Tests read `player`.
streamBytes()
  .then((bytes) => Object.assign(window, { player: new Player(bytes) }))
  .catch(sayFailure);
