/** The server of `morgs-mi view`: a stream that may grow, and images of it (morgs_mi/playback/viewer). */

import type { CameraFields } from "./stream";

export interface Part {
  bytes: Uint8Array<ArrayBuffer>;
  /** Whether these are all bytes of the stream, not those by which it has grown. */
  whole: boolean;
  /** Whether the stream is the provisional first frame of a fit. */
  provisional: boolean;
}

export class Server {
  private etag: string | null = null;
  private length = 0;

  constructor(private readonly address: string) {}

  /** Return what was added to the stream since the last call, all of it if it was replaced, or null: nothing. */
  async poll(): Promise<Part | null> {
    const headers = new Headers();
    if (this.etag !== null) {
      headers.set("Range", `bytes=${this.length - 1}-`); // the last byte again, because no range may be empty
      headers.set("If-Range", this.etag);
    }
    const response = await fetch(this.address, { headers });
    if (response.status === 416) {
      this.forget(); // the file was truncated
      return null;
    }
    if (!response.ok) {
      this.forget(); // another file was in its place
      throw new Error(await response.text());
    }
    const bytes = new Uint8Array(await response.arrayBuffer());
    const whole = response.status === 200;
    this.length = whole ? bytes.length : this.length + bytes.length - 1;
    this.etag = bytes.length > 0 ? response.headers.get("ETag") : null;
    if (!whole && bytes.length === 1) return null;
    const provisional = response.headers.get("Content-Location") === "provisional.morgs";
    return { bytes: whole ? bytes : bytes.slice(1), whole, provisional };
  }

  /** Read the whole stream the next time. */
  forget(): void {
    this.etag = null;
    this.length = 0;
  }
}

/** Return the PSNR of the exact image of a recorded camera against the recorded image, dB. */
export async function psnr({ background: _, ...camera }: CameraFields, view: number, frame: number): Promise<number> {
  const query = new URLSearchParams({ camera: JSON.stringify(camera), scale: "1" });
  const pixels = async (address: string) => {
    const bitmap = await createImageBitmap((await requested(address))!);
    const context = new OffscreenCanvas(bitmap.width, bitmap.height).getContext("2d")!;
    context.drawImage(bitmap, 0, 0);
    return context.getImageData(0, 0, bitmap.width, bitmap.height).data;
  };
  const [truth, image] = await Promise.all([`recorded/${view}/${frame}`, `exact/${frame}/color?${query}`].map(pixels));
  let squares = 0;
  for (let i = 0; i < truth.length; i++) squares += (truth[i] - image[i]) ** 2;
  return 10 * Math.log10((0.75 * truth.length * 255 ** 2) / squares); // one of four values is alpha
}

/** Time until an image is requested again after the server has turned to a newer request, in milliseconds. */
const RETRY = 300;

/** An image of the server over the page's own. */
export class Overlay {
  private wanted: string | null = null;
  private shown: string | null = null;
  private loading = false;

  /**
   * @param image where it is shown
   * @param group part of an address: an image stays until the next one of the same group arrives
   * @param failed called with the reason if there is no image, and with null if there is one
   */
  constructor(
    private readonly image: HTMLImageElement,
    private readonly group: (address: string) => string,
    private readonly failed: (reason: string | null) => void,
  ) {}

  /** Whether the wanted image is shown, if there is one. */
  get settled(): boolean {
    return this.wanted === this.shown;
  }

  /** Show the image of an address as soon as it arrives; null: none. */
  show(address: string | null): void {
    if (address === this.wanted) return;
    const stays = address !== null && this.wanted !== null && this.group(address) === this.group(this.wanted);
    if (!stays) this.clear();
    this.wanted = address;
    if (!this.loading) void this.load();
  }

  private clear(): void {
    this.image.hidden = true;
    this.shown = null;
    this.failed(null);
  }

  /** Load the wanted image; those that were wanted while another one was loading are skipped. */
  private async load(): Promise<void> {
    this.loading = true;
    while (this.wanted !== null && this.wanted !== this.shown) {
      const address = this.wanted;
      const image = await requested(address).catch((error: Error) => error);
      const current = this.wanted !== null && this.group(address) === this.group(this.wanted);
      if (image === null) await new Promise((resume) => setTimeout(resume, RETRY));
      else if (current) await this.put(address, image);
    }
    this.loading = false;
  }

  private async put(address: string, image: Blob | Error): Promise<void> {
    this.shown = address;
    this.failed(image instanceof Error ? image.message : null);
    this.image.hidden = image instanceof Error;
    if (image instanceof Error) return;
    URL.revokeObjectURL(this.image.src);
    this.image.src = URL.createObjectURL(image);
    await this.image.decode().catch(() => {});
  }
}

/** Return the image of an address; null: the server has turned to a newer request. */
async function requested(address: string): Promise<Blob | null> {
  const response = await fetch(address);
  if (response.status === 204) return null;
  if (!response.ok) throw new Error(await response.text());
  return response.blob();
}
