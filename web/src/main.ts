/** The page: its controls, and what connects playback, view and drawing. */

import * as THREE from "three";
import { positionOf } from "./cameras";
import { CONFIDENCE_GRADIENT } from "./colors";
import { Playback } from "./playback";
import { Overlay, type Part, psnr, Server } from "./server";
import { GROUNDS, type Mode, MODES, Splats } from "./splats";
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
/** A note that answers to an action goes after so many milliseconds. */
const NOTED = 5000;
const NO_WEBGL =
  "This page needs WebGL 2, which this browser does not offer: switch on hardware acceleration in its settings, or open " +
  "the page in another browser or on another device.";
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
  notes.hidden = notes.textContent!.trim() === "";
}

async function begin(): Promise<void> {
  if (document.createElement("canvas").getContext("webgl2") === null) {
    element("player").classList.add("poster"); // without controls, which could move nothing
    return say(NO_WEBGL);
  }
  const { address } = element("stream").dataset;
  const { server } = element("player").dataset;
  const served = server === "none" ? null : new Server(address!);
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

/** Return a time in words, as `duration` in morgs_mi/platform/progress.py. */
function inWords(seconds: number): string {
  const unit = Object.entries({ h: 3600, min: 60 }).find(([, length]) => seconds >= 1.5 * length) ?? ["s", 1];
  return `${Math.round(seconds / unit[1])} ${unit[0]}`;
}

/** Return the corners of a box between two of them. */
function cornersOf([low, high]: number[][]): THREE.Vector3[] {
  const choices = Array.from({ length: 8 }, (_, i) => [i & 1, i & 2, i & 4]);
  return choices.map((isHigh) => new THREE.Vector3().fromArray(isHigh.map((bit, axis) => (bit ? high : low)[axis])));
}

interface Metadata {
  /** Seconds since the fit began, and those of the steps of the first frame that are left; null before them. */
  provisional?: { seconds: number; left: number | null };
  config?: { render?: object };
  motion_scale?: number;
  default_rig?: boolean;
  /** Corners of what the cameras of a default rig should show. */
  box?: number[][] | null;
  transfer?: { display_exposure?: number };
}

class Player {
  readonly playback: Playback;
  splats!: Splats;
  private view!: View;
  private cameras: CameraFields[] = [];
  private frames: number[] = [];
  /** What the address asks for: #t=0.4&camera=left&mode=motion&pause */
  private wishes = new URLSearchParams(location.hash.slice(1));
  private started = false;
  /** Whether the first sorted picture has replaced the poster. */
  private revealed = false;
  /** What the fit expects of views between its cameras, until it was said. */
  private between = element("player").dataset.between!;
  /** Time of the last picture. */
  private ticked = 0;
  /** Motion that is fully saturated, as a fraction of the image's width per frame. */
  private motionScale = 0;
  /** Mode of the legend. */
  private legend: Mode = "color";
  private lastInput = 0;
  /** Whether it was made by a pointer. */
  private byPointer = false;
  private ground = 0;
  /** Nearest and farthest depth of the colours, page units. */
  private depths = [1, 1];
  private unit = 1;
  /** The stream, if it was opened. */
  private stream: Opened | null = null;
  /** Description of the end of a stream that may still grow. */
  private damage: string | null = null;
  /** Whether the first frame is provisional, and the PSNR of those that were, dB over seconds. */
  private provisional = false;
  private readonly curve: number[][] = [];
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
  constructor(private readonly served: boolean, private readonly hasRecording: boolean) {
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
        if (this.provisional) void this.describe(update.count);
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
    return this.revealed && !this.playback.busy && this.splats.settled && this.recorded.settled && this.exact.settled;
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
      this.provisional = provisional;
      if (!provisional) setFlag("curve", "hidden", true);
      note("provisional", provisional ? "Provisional first frame: it is still being fitted." : "");
      this.playback.open(bytes);
    } else if (this.stream === null) {
      server.forget(); // the bytes before could not be opened
    } else {
      this.playback.extend(bytes);
    }
  }

  /** Describe the provisional first frame, with the PSNR of the selected camera over the time of the fit. */
  private async describe(count: number): Promise<void> {
    const { seconds, left } = (this.stream!.metadata as Metadata).provisional ?? { seconds: 0, left: null };
    const rest = left === null ? "" : `, ${inWords(left)} left`;
    const text = `Provisional first frame: ${count.toLocaleString("en")} Gaussians, ${inWords(seconds)}${rest}`;
    note("provisional", text);
    if (!this.hasRecording) return;
    const value = await psnr(this.cameras[0], 0, this.frames[0]).catch(() => NaN);
    if (!this.provisional || !Number.isFinite(value)) return;
    this.curve.push([seconds, value]);
    note("provisional", `${text}, ${value.toFixed(1)} dB at ${this.cameras[0].name}`);
    setFlag("curve", "hidden", this.curve.length < 2);
    const [times, decibels] = [0, 1].map((i) => this.curve.map((point) => point[i]));
    const least = Math.min(...decibels);
    const height = 30 / Math.max(1, Math.max(...decibels) - least); // 1 dB or more
    const points = times.map((time, i) => `${(100 * time) / seconds},${30 - height * (decibels[i] - least)}`);
    element("curve").querySelector("polyline")!.setAttribute("points", points.join(" "));
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
    if (frames.length > 1) element("player").dataset.frames = String(frames.length);
    if (this.started) this.count();
  }

  /** Set up what depends on the cameras and the settings of the stream. */
  private setUp(stream: Opened): void {
    this.cameras = stream.cameras;
    const unit = (this.unit = unitOf(this.cameras));
    const metadata = stream.metadata as Metadata;
    this.motionScale = metadata.motion_scale ?? 0.03;
    this.splats = new Splats(canvas, stream.metadata, unit);
    this.splats.expose(metadata.transfer?.display_exposure ?? 0);
    const recorded = metadata.default_rig !== true;
    element("player").dataset.recorded = String(recorded);
    const box = metadata.box ? cornersOf(metadata.box) : [];
    this.view = new View(this.cameras, unit, canvas, element("image"), box, recorded, () => this.followView());
    cameraList.replaceChildren(...this.cameras.map(({ name }, i) => new Option(name, String(i))));
  }

  /** Begin with the first frame that is shown. */
  private start(): void {
    this.started = true;
    // Nothing is drawn before the camera is known: pictures sorted for another one are inside out.
    this.selectCamera(0);
    this.resize();
    this.leaveFirst();
    this.selectMode("color");
    this.comply();
    this.listen();
    const followSize = () => {
      this.resize();
      this.splats.draw(this.view.camera);
    };
    new ResizeObserver(followSize).observe(canvas);
    requestAnimationFrame((now) => this.tick(now));
  }

  /** Show the first sorted picture in place of the poster, and begin to play. */
  private reveal(): void {
    this.revealed = true;
    element("player").classList.remove("loading");
    this.lastInput = performance.now();
    if (this.wishes.has("recorded")) this.wipe(Number(this.wishes.get("recorded")));
    if (this.wishes.has("exact")) this.render();
    const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const paused = still || this.wishes.has("pause") || this.wishes.has("follow");
    this.playback.play(!paused && this.frames.length > 1);
  }

  /** Do what the address asks for. */
  private comply(): void {
    const { wishes, playback, frames } = this;
    const number = (name: string) => Number(wishes.get(name));
    const camera = this.cameras.findIndex(({ name }) => name === wishes.get("camera"));
    if (camera >= 0) this.selectCamera(camera);
    const place = wishes.get("view")?.split(",").map(Number) ?? [];
    if (place.length === 6 && place.every(Number.isFinite)) {
      if (this.view.bounded) this.bound();
      this.view.look({ position: place.slice(0, 3), target: place.slice(3) });
    }
    if (wishes.has("follow")) playback.seek(playback.last);
    else if (wishes.has("t")) playback.seek(Math.round(number("t") * playback.fps) || 0);
    else if (wishes.has("frame")) playback.seek(frames.indexOf(number("frame")));
    const mode = MODES.find((name) => name === wishes.get("mode"));
    if (mode !== undefined) this.selectMode(mode);
  }

  /** Write what is shown into the address, and copy it. */
  private async share(): Promise<void> {
    const { view, playback, splats } = this;
    const wishes = [`t=${(playback.position / playback.fps).toFixed(2)}`];
    wishes.push(`camera=${encodeURIComponent(this.cameras[Number(cameraList.value)].name)}`);
    if (splats.mode !== "color") wishes.push(`mode=${splats.mode}`);
    const { position, target } = view.place;
    const place = [...position, ...target];
    const least = 1e-9 * Math.max(...place.map(Math.abs)); // of rounding errors
    if (!view.atCamera) wishes.push(`view=${place.map((x) => (Math.abs(x) < least ? 0 : Number(x.toPrecision(6))))}`);
    const address = `${location.href.split("#")[0]}#${wishes.join("&")}&pause`;
    try {
      history.replaceState(null, "", address);
      await navigator.clipboard.writeText(address);
      this.tell("The address of this view is copied.");
    } catch {
      this.tell("The address of this page has this view.");
    }
  }

  private screenshot(): void {
    this.splats.repaint(this.view.camera);
    canvas.toBlob((image) => {
      const link = document.createElement("a");
      link.download = `${document.title} ${element("count").textContent!.split(" ")[0]}.png`;
      link.href = URL.createObjectURL(image!);
      link.click();
      URL.revokeObjectURL(link.href);
    });
  }

  /** Show a note for a while. */
  private tell(text: string): void {
    note("answer", text);
    setTimeout(() => note("answer", ""), NOTED);
  }

  private nextGround(): void {
    this.ground = (this.ground + 1) % GROUNDS.length;
    this.splats.setGround(GROUNDS[this.ground]);
    this.tell(`Background: ${GROUNDS[this.ground]}.`);
  }

  private focus({ clientX, clientY }: MouseEvent): void {
    const { width, height } = canvas.getBoundingClientRect();
    const point = this.splats.surface(this.view.camera, (2 * clientX) / width - 1, 1 - (2 * clientY) / height);
    if (point !== null) this.view.orbit(point);
  }

  private tick(now: number): void {
    this.playback.tick(now);
    this.view.update((now - this.ticked) / 1000);
    this.ticked = now;
    this.splats.draw(this.view.camera);
    if (this.between !== "" && this.revealed && !this.view.atCamera) {
      this.tell(`Between the cameras: ${this.between}.`);
      this.between = "";
    }
    if (!this.revealed && !this.playback.busy && this.splats.settled) this.reveal();
    if (this.legend !== this.splats.shown) this.showLegend(this.splats.shown);
    if (this.served) this.compare(now);
    element("player").classList.toggle("idle", this.playback.playing && now - this.lastInput > IDLE);
    requestAnimationFrame((next) => this.tick(next));
  }

  private count(): void {
    const { position, last } = this.playback;
    element("count").textContent = `${this.frames[position]} / ${this.frames[last]}`;
    element("clock").textContent = `${(position / this.playback.fps).toFixed(2)} s`;
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
    // The server has no such images.
    const draws = this.splats.mode !== "depth" && this.cameras[Number(cameraList.value)].background === undefined;
    this.exact.show(pressed("exact") && rests && draws ? this.exactAddress(frame) : null);
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
    const { atCamera, rectangle } = this.view;
    element("image").classList.toggle("matte", atCamera);
    this.splats.showBackdrop(atCamera ? rectangle : null);
  }

  private resize(): void {
    const { clientWidth, clientHeight } = canvas;
    if (clientWidth === 0 || clientHeight === 0) return;
    this.splats.resize(clientWidth, clientHeight, Math.min(devicePixelRatio, 2));
    this.view.layOut();
  }

  private selectCamera(index: number): void {
    cameraList.value = String(index);
    this.splats.loadBackdrop(this.cameras[index].background);
    this.view.select(index, (camera) => this.splats.seen(camera));
    this.scaleDepth();
  }

  private scaleDepth(): void {
    if (this.splats.mode !== "depth") return;
    this.depths = this.splats.scaleDepth(this.view.camera);
    this.showLegend("depth");
  }

  private selectMode(mode: Mode): void {
    this.changed = performance.now();
    this.splats.setMode(mode);
    this.followView();
    for (const button of modeButtons) button.ariaPressed = String(button.dataset.mode === mode);
    if (mode === "motion" || mode === "confidence") this.leaveFirst();
    this.scaleDepth();
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
    const [near, far] = this.depths.map((depth) => (depth / this.unit).toPrecision(3));
    legend.querySelector(".near")?.replaceChildren(near);
    legend.querySelector(".far")?.replaceChildren(far);
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
    if (element("player").dataset.recorded === "false") return; // there are no recorded views to stay near
    this.view.bounded = !this.view.bounded;
    element("bound").ariaPressed = String(this.view.bounded);
  }

  /** Show the recorded image on a share of the page in percent, or no more. */
  private wipe(share = HALF): void {
    if (!this.hasRecording) return;
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
    on("ground", () => this.nextGround());
    on("shot", () => this.screenshot());
    on("send", () => void this.share());
    canvas.addEventListener("dblclick", (event) => this.focus(event));
    addEventListener("hashchange", () => {
      this.wishes = new URLSearchParams(location.hash.slice(1));
      this.comply();
    });
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
      const listen = () => {
        this.lastInput = performance.now();
        this.byPointer = event !== "keydown";
      };
      addEventListener(event, listen, { capture: true });
    }
    // What was clicked must not take the keys.
    for (const event of ["click", "change"]) {
      element("bar").addEventListener(event, ({ target }) => {
        if (this.byPointer && (event === "change" || target !== cameraList && target !== speedList)) canvas.focus({ focusVisible: false } as FocusOptions);
      });
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
    const ofClip: Record<string, () => void> = {
      " ": () => this.toggle(),
      k: () => this.toggle(),
      ArrowLeft: () => this.step(-1),
      ArrowRight: () => this.step(1),
      Home: () => this.step(-Infinity),
      End: () => this.step(Infinity),
      "2": () => this.selectMode("motion"),
      "3": () => this.selectMode("confidence"),
      "<": () => this.selectSpeed(speedList.selectedIndex - 1),
      ">": () => this.selectSpeed(speedList.selectedIndex + 1),
      l: () => this.repeat(),
    };
    const actions: Record<string, () => void> = {
      ...(this.frames.length > 1 ? ofClip : {}),
      "+": () => this.view.zoom(1 / 1.1),
      "-": () => this.view.zoom(1.1),
      "1": () => this.selectMode("color"),
      "4": () => this.selectMode("depth"),
      w: () => this.view.walk(0, 0, 1),
      s: () => this.view.walk(0, 0, -1),
      a: () => this.view.walk(-1, 0, 0),
      d: () => this.view.walk(1, 0, 0),
      q: () => this.view.walk(0, -1, 0),
      e: () => this.view.walk(0, 1, 0),
      g: () => this.nextGround(),
      p: () => this.screenshot(),
      u: () => void this.share(),
      c: () => this.selectCamera((camera + 1) % this.cameras.length),
      r: () => this.selectCamera(camera),
      "[": () => this.splats.expose(-0.5),
      "]": () => this.splats.expose(0.5),
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
