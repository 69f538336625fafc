/** A stream in a scene of three.js that Spark draws: the module morgs-spark.js (docs/web-player.md). */

import * as THREE from "three";
import { focus, poseOf, turntableUp, upright } from "./cameras";
import { background, rendererOptions, StreamMesh } from "./mesh";
import { Playback } from "./playback";
import { type CameraFields, download } from "./stream";
import type { Opened } from "./worker";

export class MorgsSplats {
  /** The Gaussians, with y up: a SplatMesh to add to the scene. */
  readonly mesh: StreamMesh;
  /** The recorded cameras, in the axes of the recording. */
  readonly cameras: CameraFields[];
  /** Numbers of the frames. */
  readonly frames: number[];
  readonly fps: number;
  /** Options of a SparkRenderer with which the images are those of morgs-mi. */
  readonly rendererOptions: ReturnType<typeof rendererOptions>;
  /** Colour behind the Gaussians in the fit, for the `background` of a scene. */
  readonly background: THREE.Color;
  /** Description of the damage that ends the frames that play, if there is any. */
  damage: string | null;
  private wanted = 0;

  private constructor(private readonly playback: Playback, mesh: StreamMesh, stream: Opened) {
    this.mesh = mesh;
    ({ cameras: this.cameras, frames: this.frames, damage: this.damage } = stream);
    this.fps = playback.fps;
    this.rendererOptions = rendererOptions(stream.metadata);
    this.background = background(stream.metadata);
    mesh.quaternion.copy(upright(this.cameras));
  }

  /** Load a stream; the mesh shows its first frame. Fails if it cannot be read, or if that frame cannot be decoded. */
  static async load(address: string | URL): Promise<MorgsSplats> {
    const mesh = new StreamMesh();
    const bytes = await download(address);
    return new Promise((resolve, reject) => {
      let splats: MorgsSplats | null = null;
      const playback = new Playback({
        opened: (stream) => {
          splats = new MorgsSplats(playback, mesh, stream);
          playback.seek(0);
        },
        show: (update) => {
          mesh.apply(update);
          resolve(splats!);
        },
        failed: (message) => {
          if (splats !== null && playback.position >= 0) {
            splats.damage ??= message;
          } else {
            playback.dispose();
            reject(new Error(`${address}: ${message}`));
          }
        },
        playing: () => {},
      });
      playback.open(bytes);
    });
  }

  /** Seconds until the stream repeats. */
  get duration(): number {
    return this.frames.length / this.fps;
  }

  /** Index into `frames` of the frame that the mesh shows. */
  get position(): number {
    return this.playback.position;
  }

  /** Show the frame of a time as soon as it is decoded; the frame before stays until then. The stream repeats. */
  update(seconds: number): void {
    const count = this.frames.length;
    const position = ((Math.floor(seconds * this.fps + 1e-6) % count) + count) % count;
    if (position === this.wanted || this.playback.busy) return;
    this.wanted = position;
    this.playback.seek(position);
  }

  /**
   * Give a camera the pose of a recorded one, its up direction, and a projection with its whole image. Return the
   * point on its axis at the median depth of the Gaussians, to orbit around.
   */
  place(camera: THREE.PerspectiveCamera, index = 0): THREE.Vector3 {
    const recorded = this.cameras[index];
    const scale = new THREE.Vector3();
    this.mesh.updateWorldMatrix(true, false);
    poseOf(recorded).premultiply(this.mesh.matrixWorld).decompose(camera.position, camera.quaternion, scale);
    camera.up.copy(turntableUp(recorded, this.cameras)).transformDirection(this.mesh.matrixWorld);
    camera.near = recorded.near * scale.x;
    focus(camera, recorded);
    camera.updateMatrixWorld();
    return new THREE.Vector3(0, 0, -this.mesh.medianDepth(camera)).applyMatrix4(camera.matrixWorld);
  }

  dispose(): void {
    this.playback.dispose();
    this.mesh.dispose();
  }
}
