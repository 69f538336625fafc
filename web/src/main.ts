/** The page: its controls, and what connects playback, view and drawing. */

import { positionOf } from "./cameras";
import { CONFIDENCE_GRADIENT } from "./colors";
import { Playback } from "./playback";
import { Overlay, type Part, Server } from "./server";
import { type Mode, MODES, Splats } from "./splats";
import { type CameraFields, download } from "./stream";
import { View } from "./view";
import type { Opened } from "./worker";

declare function embedded(id: string): Uint8Array<ArrayBuffer>;

const PLAY = "M7 4v16l13-8z";
const PAUSE = "M6 4h4v16H6zM14 4h4v16h-4z";
/** The controls fade after so many milliseconds without input while the clip plays. */
const IDLE = 3000;
/** Period in which the server is asked whether the stream has grown, milliseconds. */
const POLL = 1000;
/** The view rests after so many milliseconds without a change. */
const REST = 200;
/** Share of the page that shows the recording at first, percent. */
const HALF = 50;

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

function unsay(): void {
  element("message").hidden = true;
}

/** Show short notes, one for each topic; the text of an empty one is "". */
function note(topic: string, text: string): void {
  const notes = element("notes");
  const line = notes.querySelector(`[data-topic=${topic}]`) ?? notes.appendChild(document.createElement("div"));
  (line as HTMLElement).dataset.topic = topic;
  line.textContent = text;
  notes.hidden = notes.textContent === "";
}

async function begin(): Promise<void> {
  const { address, server } = element("stream").dataset;
  const served = server === undefined ? null : new Server(address!);
  const player = new Player(served !== null, server === "recorded");
  Object.assign(window, { player }); // for tests
  if (served !== null) await player.follow(served);
  else player.playback.open(address === undefined ? embedded("stream") : await download(address));
}

function sameRig(a: Opened, b: Opened): boolean {
  const settings = ({ cameras, metadata }: Opened) => JSON.stringify([cameras, (metadata as Metadata).config?.render]);
  return settings(a) === settings(b);
}

/** Set or remove an attribute, unless it is so: every change costs a new layout. */
function setFlag(id: string, name: string, value: boolean): void {
  if (element(id).hasAttribute(name) !== value) element(id).toggleAttribute(name, value);
}

/** Whether a button that stays pressed is. */
function pressed(id: string): boolean {
  return element(id).ariaPressed === "true";
}

/** Scale of the page's units: the rig spans four, as Spark's thresholds are absolute. */
function unitOf(cameras: CameraFields[]): number {
  const positions = cameras.map(positionOf);
  const span = Math.max(...positions.map((position) => position.distanceTo(positions[0])));
  return 4 / (span || positions[0].length() || 4);
}

interface Metadata {
  config?: { render?: object };
  motion_scale?: number;
  default_rig?: boolean;
  transfer?: { display_exposure?: number };
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
  /** The stream, if it was opened. */
  private stream: Opened | null = null;
  /** Description of the end of a stream that may still grow. */
  private damage: string | null = null;
  /** Time of the last change of what is shown. */
  private changed = 0;
  private readonly recorded = new Overlay(
    element<HTMLImageElement>("recording"),
    (address) => address.slice(0, address.lastIndexOf("/")),
    (reason) => note("recording", reason === null ? "" : `No recorded image: ${reason}`),
  );
  private readonly exact = new Overlay(
    element<HTMLImageElement>("rendering"),
    (address) => address,
    (reason) => note("rendering", reason === null ? "" : `No exact image: ${reason}`),
  );

  /**
   * @param served whether a server renders images, and adds to the stream
   * @param hasRecording whether it has recorded images
   */
  constructor(private readonly served: boolean, hasRecording: boolean) {
    element("player").classList.toggle("served", served);
    element("wipe").hidden = !hasRecording;
    this.playback = new Playback({
      opened: (stream) => this.open(stream),
      grown: ({ frames, damage }) => {
        const follows = !this.playback.playing && this.playback.aim === this.frames.length - 1;
        this.damage = damage;
        this.setFrames(frames);
        unsay();
        if (follows) this.playback.seek(this.playback.last);
      },
      show: (update, position) => {
        this.splats.apply(update);
        slider.value = String(position);
        modeButtons.find(({ dataset }) => dataset.mode === "confidence")!.hidden = !update.confidence;
        this.changed = performance.now();
        this.count();
        if (!this.started) this.start();
      },
      failed: (message) => {
        if (this.started) this.sayDamage(message);
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
    return this.started && !this.playback.busy && this.splats.settled && this.recorded.settled && this.exact.settled;
  }

  /** Show the stream of a server, also what it adds later. */
  async follow(server: Server): Promise<never> {
    for (let lost = false; ; await new Promise((resume) => setTimeout(resume, POLL))) {
      try {
        const part = await server.poll();
        if (lost) unsay();
        lost = false;
        if (part !== null) this.take(part, server);
        else if (this.damage !== null) this.sayDamage(this.damage); // what is still being written grows within a second
      } catch (error) {
        lost = true;
        // A TypeError: there is no answer.
        const refusal = error instanceof TypeError ? null : (error as Error).message;
        say(refusal ?? "The server of this page does not answer: start morgs-mi view again, or wait.");
      }
    }
  }

  private take({ bytes, whole, provisional }: Part, server: Server): void {
    if (whole) {
      this.damage = null;
      note("provisional", provisional ? "Provisional first frame: it is still being fitted." : "");
      this.playback.open(bytes);
    } else if (this.stream === null) {
      server.forget(); // the bytes before could not be opened
    } else {
      this.playback.extend(bytes);
    }
  }

  private sayDamage(damage: string): void {
    say(`This stream is damaged: ${damage}.${this.frames.length ? " The frames before that play." : ""}`);
  }

  private open(stream: Opened): void {
    const { stream: before, playback } = this;
    if (before !== null && !sameRig(before, stream)) return location.reload();
    const follows = !playback.playing && playback.position === this.frames.length - 1;
    this.stream = stream;
    unsay();
    if (this.served) this.damage = stream.damage;
    else if (stream.damage !== null) this.sayDamage(stream.damage);
    if (before === null) this.setUp(stream);
    this.setFrames(stream.frames);
    playback.seek(before === null ? 0 : follows ? playback.last : playback.position);
  }

  private setFrames(frames: number[]): void {
    this.frames = frames;
    slider.max = String(frames.length - 1);
    element("player").classList.toggle("still", frames.length === 1);
    if (this.started) this.count();
  }

  /** Set up what depends on the cameras and the settings of the stream. */
  private setUp(stream: Opened): void {
    this.cameras = stream.cameras;
    const unit = unitOf(this.cameras);
    const metadata = stream.metadata as Metadata;
    this.motionScale = metadata.motion_scale ?? 0.03;
    this.splats = new Splats(canvas, stream.metadata, unit);
    this.splats.expose(metadata.transfer?.display_exposure ?? 0);
    this.view = new View(this.cameras, unit, canvas, () => this.followView());
    if (metadata.default_rig === true) this.bound(); // no recorded views to stay near
    cameraList.replaceChildren(...this.cameras.map(({ name }, i) => new Option(name, String(i))));
  }

  /** Begin with the first frame that is shown. */
  private start(): void {
    this.started = true;
    new ResizeObserver(() => this.resize()).observe(canvas);
    this.resize();
    const wished = this.cameras.findIndex(({ name }) => name === this.wishes.get("camera"));
    this.selectCamera(Math.max(0, wished));
    if (this.wishes.has("follow")) this.playback.seek(this.playback.last);
    else if (this.wishes.has("frame")) this.playback.seek(this.frames.indexOf(Number(this.wishes.get("frame"))));
    else this.leaveFirst();
    this.selectMode(MODES.find((mode) => mode === this.wishes.get("mode")) ?? "color");
    this.listen();
    this.lastInput = performance.now();
    if (this.wishes.has("recorded")) this.wipe(Number(this.wishes.get("recorded")));
    if (this.wishes.has("exact")) this.render();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const paused = still || this.wishes.has("pause") || this.wishes.has("follow");
    this.playback.play(!paused && this.frames.length > 1);
    requestAnimationFrame((now) => this.tick(now));
  }

  private tick(now: number): void {
    this.playback.tick(now);
    this.view.update();
    this.splats.draw(this.view.camera);
    if (this.legend !== this.splats.shown) this.showLegend(this.splats.shown);
    if (this.served) this.compare(now);
    element("player").classList.toggle("idle", this.playback.playing && now - this.lastInput > IDLE);
    requestAnimationFrame((next) => this.tick(next));
  }

  private count(): void {
    const { position, last } = this.playback;
    element("count").textContent = `${this.frames[position]} / ${this.frames[last]}`;
    element("player").classList.toggle("first", position === 0);
  }

  /** Show what the server has: the recorded image of the camera, and the exact image of a view that rests. */
  private compare(now: number): void {
    const { playback, view } = this;
    const frame = this.frames[playback.position];
    const wipes = pressed("wipe") && view.atCamera;
    this.recorded.show(wipes ? `recorded/${cameraList.value}/${frame}` : null);
    const splits = wipes && !element("recording").hidden;
    setFlag("split", "hidden", !splits);
    setFlag("share", "hidden", !splits);
    const rests = !playback.playing && !playback.busy && now - this.changed > REST;
    this.exact.show(pressed("exact") && rests ? this.exactAddress(frame) : null);
    setFlag("exact", "data-busy", !this.exact.settled);
  }

  private exactAddress(frame: number): string {
    const camera = this.view.fields(canvas.width, canvas.height);
    const scale = this.view.tangent(this.motionScale) * camera.K[0][0];
    return `exact/${frame}/${this.splats.mode}?${new URLSearchParams({ camera: JSON.stringify(camera), scale: String(scale) })}`;
  }

  private followView(): void {
    this.changed = performance.now();
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
    this.changed = performance.now();
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

  /** Show the recorded image on a share of the page in percent, or no more. */
  private wipe(share = HALF): void {
    if (element("wipe").hidden) return;
    element("wipe").ariaPressed = String(!pressed("wipe"));
    this.split(share);
    element<HTMLInputElement>("share").value = String(share);
  }

  private split(share: number): void {
    element("player").style.setProperty("--share", `${share}%`);
  }

  private render(): void {
    if (this.served) element("exact").ariaPressed = String(!pressed("exact"));
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
    on("wipe", () => this.wipe());
    on("exact", () => this.render());
    const share = element<HTMLInputElement>("share");
    share.addEventListener("input", () => this.split(Number(share.value)));
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
    const onButton = target instanceof HTMLButtonElement && key === " ";
    const onControl = onButton || target instanceof HTMLSelectElement || target === element("share");
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
      "[": () => this.splats.expose(-0.5),
      "]": () => this.splats.expose(0.5),
      l: () => this.repeat(),
      b: () => this.bound(),
      v: () => this.wipe(),
      x: () => this.render(),
      f: () => this.fullScreen(),
      "?": () => element<HTMLDialogElement>("help").showModal(),
    };
    const action = (event.shiftKey && orbit[key]) || actions[key.length === 1 ? key.toLowerCase() : key];
    if (action === undefined) return;
    event.preventDefault();
    action();
  }
}

begin().catch(sayFailure);
