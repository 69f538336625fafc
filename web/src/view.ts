/** The camera: the views of the rig, and orbiting from there. */

import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { axisOf, positionOf, turntableUp } from "./cameras";
import { quantile, type Seen } from "./mesh";
import type { CameraFields } from "./stream";

/**
 * Angle around the direction of each camera in which orbits are free. Views between cameras that are twice as far apart
 * are fair, and between cameras farther apart poor (morgs_mi/fit/forecast.py). A camera without such a neighbour has half
 * of it, because a fit of few views falls apart sooner.
 */
const REACH = THREE.MathUtils.degToRad(8);
/** Seconds in which the view turns back by half of the angle beyond it. */
const HALVED = 1 / 60;
/** Distance, in units of the page, and angle up to which the view is at a camera: rounding of the controls. */
const AT_CAMERA = 1e-4;

/** Share of the distance to what the view orbits around by which a key moves it. */
const STRIDE = 0.06;

/** A rectangle on the page, pixels. */
export interface Rectangle {
  x: number;
  y: number;
  width: number;
  height: number;
}

/** Where the view is and what it orbits around, world units. */
export interface Place {
  position: number[];
  target: number[];
}

export class View {
  readonly camera = new THREE.PerspectiveCamera();
  /** Where the whole image of the selected camera lies on the page. */
  rectangle: Rectangle = { x: 0, y: 0, width: 1, height: 1 };
  private controls: OrbitControls | null = null;
  private current: CameraFields;
  /** Pose of the view at the selected camera. */
  private readonly home = new THREE.Object3D();
  /** Positions of the rig's cameras. */
  private readonly positions: THREE.Vector3[];

  /**
   * @param image element that the style of the page lays where the image of the selected camera is
   * @param box corners of what cameras that were not recorded should show, world units
   * @param bounded whether orbits are drawn back to the directions of the rig's cameras
   */
  constructor(
    private readonly cameras: CameraFields[],
    private readonly unit: number,
    private readonly element: HTMLElement,
    private readonly image: HTMLElement,
    private readonly box: THREE.Vector3[],
    public bounded: boolean,
    private readonly onChange: () => void,
  ) {
    this.current = cameras[0];
    this.positions = cameras.map((camera) => positionOf(camera).multiplyScalar(unit));
  }

  /**
   * Show what a camera of the rig sees; orbits turn around the point on its axis at the median depth of the Gaussians,
   * which `seen` returns.
   */
  select(index: number, seen: (camera: THREE.PerspectiveCamera) => Seen[]): void {
    this.current = this.cameras[index];
    const { camera, unit } = this;
    const ahead = axisOf(this.current, 2);
    camera.position.copy(positionOf(this.current)).multiplyScalar(unit);
    camera.near = this.current.near * unit;
    camera.far = 1e5;
    camera.up.copy(turntableUp(this.current, this.cameras));
    camera.lookAt(ahead.clone().add(camera.position));
    this.project({ x: 0, y: 0, ...this.size }); // the image fills the page
    const places = seen(camera);
    this.compose(places);
    this.layOut();
    this.controls?.dispose();
    this.controls = new OrbitControls(camera, this.element);
    this.controls.target.copy(camera.position).addScaledVector(ahead, quantile(places.map(({ depth }) => depth)) ?? 1);
    this.controls.enableDamping = true;
    this.controls.dampingFactor = 0.15;
    this.controls.zoomSpeed = 0.7;
    this.controls.addEventListener("change", this.onChange);
    this.controls.update();
    this.home.position.copy(camera.position);
    this.home.quaternion.copy(camera.quaternion);
    this.onChange();
  }

  /** Describe to the style what the page shows of the image: all of it, or the box, and where things move. */
  private compose(places: Seen[]): void {
    const { width, height } = this.current;
    const across = (x: number) => ((1 + x) / 2) * width;
    const down = (y: number) => ((1 - y) / 2) * height;
    const corners = this.box.map((corner) => corner.clone().multiplyScalar(this.unit).project(this.camera));
    const xs = this.box.length > 0 ? corners.map(({ x }) => across(x)) : [0, width];
    const ys = this.box.length > 0 ? corners.map(({ y }) => down(y)) : [0, height];
    const [x, y] = [Math.min(...xs), Math.min(...ys)];
    const motion = quantile(places.filter(({ moves }) => moves).map((place) => across(place.x))) ?? width / 2;
    const shown = { x, y, width: Math.max(...xs) - x, height: Math.max(...ys) - y };
    const values = { "image-width": width, "image-height": height, ...shown, motion };
    for (const [name, value] of Object.entries(values)) this.image.style.setProperty(`--${name}`, String(value));
  }

  /** Size of the page, pixels. */
  private get size() {
    return { width: this.element.clientWidth, height: this.element.clientHeight };
  }

  /** Where the view is. */
  get place(): Place {
    const [position, target] = [this.camera.position, this.controls!.target].map((point) =>
      point.clone().divideScalar(this.unit).toArray(),
    );
    return { position, target };
  }

  /** Look from a place in the upright direction of the selected camera. */
  look({ position, target }: Place): void {
    this.bounded = false;
    this.camera.position.fromArray(position).multiplyScalar(this.unit);
    this.orbit(new THREE.Vector3().fromArray(target).multiplyScalar(this.unit));
  }

  /** Orbit around a point, in units of the page. */
  orbit(target: THREE.Vector3): void {
    this.controls!.target.copy(target);
    this.controls!.update();
  }

  /** Move sideways, up and ahead by strides. */
  walk(right: number, up: number, ahead: number): void {
    if (this.controls === null) return;
    const { camera, controls } = this;
    const step = new THREE.Vector3(right, up, -ahead).applyQuaternion(camera.quaternion);
    step.multiplyScalar(STRIDE * camera.position.distanceTo(controls.target));
    camera.position.add(step);
    this.orbit(controls.target.clone().add(step));
  }

  /** Whether the view is the one of the selected camera. */
  get atCamera(): boolean {
    const { position, quaternion } = this.camera;
    const distance = position.distanceTo(this.home.position);
    return distance < AT_CAMERA && quaternion.angleTo(this.home.quaternion) < AT_CAMERA;
  }

  /** The view as a camera with an image of a size in pixels. */
  fields(width: number, height: number): CameraFields {
    const { K, near } = this.current;
    const { size, unit, rectangle, scale } = this;
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorldInverse.elements;
    const [right, up, back] = [0, 1, 2].map((i) => [m[i], m[4 + i], m[8 + i], m[12 + i] / unit]);
    const flipped = (row: number[]) => row.map((value) => -value);
    const [x, y] = [width / size.width, height / size.height];
    // prettier-ignore
    return {
      name: "page",
      K: [
        [x * scale * K[0][0], 0, x * (rectangle.x + scale * K[0][2])],
        [0, y * scale * K[1][1], y * (rectangle.y + scale * K[1][2])],
        [0, 0, 1],
      ],
      viewmat: [right, flipped(up), flipped(back), [0, 0, 0, 1]],
      width, height, near,
    };
  }

  /** Follow the size of the page, and the place of the image on it. */
  layOut(): void {
    this.rectangle = this.image.getBoundingClientRect();
    this.project(this.rectangle);
    this.onChange();
  }

  /** Continue a movement that slows down, and draw an orbit back that has left the rig, for some seconds. */
  update(seconds: number): void {
    if (this.controls === null) return;
    this.controls.update();
    if (this.bounded) this.drawBack(this.controls, 1 - 0.5 ** (seconds / HALVED));
  }

  /**
   * Turn towards the nearest camera of the rig, as seen from what the view orbits around, where it is too far away, by a
   * share of the angle beyond.
   */
  private drawBack(controls: OrbitControls, share: number): void {
    const { target } = controls;
    const offset = this.camera.position.clone().sub(target);
    const directions = this.positions.map((position) => position.clone().sub(target));
    const angles = directions.map((direction) => direction.angleTo(offset));
    const angle = Math.min(...angles);
    const nearest = directions[angles.indexOf(angle)];
    const around = directions.filter((direction) => direction.angleTo(nearest) < 2 * REACH); // itself included
    const beyond = angle - (around.length > 1 ? REACH : REACH / 2);
    if (beyond < 1e-3) return;
    offset.applyAxisAngle(offset.clone().cross(nearest).normalize(), share * beyond);
    this.camera.position.copy(target).add(offset);
    controls.update();
  }

  /** Turn by angles in radians, positive to the right and up. */
  turn(right: number, up: number): void {
    if (this.controls === null) return;
    const { camera } = this;
    const offset = camera.position.clone().sub(this.controls.target);
    offset.applyAxisAngle(camera.up, right);
    const axis = new THREE.Vector3().crossVectors(camera.up, offset).normalize();
    offset.applyAxisAngle(axis, -up);
    if (Math.abs(offset.clone().normalize().dot(camera.up)) < 0.99) {
      camera.position.copy(this.controls.target).add(offset);
      this.controls.update();
    }
  }

  zoom(factor: number): void {
    if (this.controls === null) return;
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }

  /** Tangent of an angle that a fraction of the image's width spans. */
  tangent(fraction: number): number {
    return (fraction * this.current.width) / this.current.K[0][0];
  }

  /** Pixels of the page per pixel of the camera's image. */
  private get scale(): number {
    return this.rectangle.width / this.current.width;
  }

  /** Project the image of the selected camera onto a rectangle of the page; more is visible around it. */
  private project({ x, y, width, height }: Rectangle): void {
    const { K } = this.current;
    const page = this.size;
    const { camera } = this;
    const [scaleX, scaleY] = [width / this.current.width, height / this.current.height];
    const { near, far } = camera;
    // prettier-ignore
    camera.projectionMatrix.set(
      (2 * K[0][0] * scaleX) / page.width, 0, 1 - (2 * (x + scaleX * K[0][2])) / page.width, 0,
      0, (2 * K[1][1] * scaleY) / page.height, (2 * (y + scaleY * K[1][2])) / page.height - 1, 0,
      0, 0, (near + far) / (near - far), (2 * far * near) / (near - far),
      0, 0, -1, 0,
    );
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    // For the speed of panning.
    camera.fov = THREE.MathUtils.radToDeg(2 * Math.atan(page.height / (2 * K[1][1] * scaleY)));
  }
}
