/** The header of a coded stream. docs/formats.md specifies it. */

export const HEADER_BYTES = 44;
const MAGIC = 0x53475354;
const VERSION = 3;
const PALETTE = 4; // flag
const GREATEST = 1e18;

/** What a stream says of all its Gaussians. */
export interface Header {
  readonly antialiased: boolean;
  readonly twoOpacities: boolean;
  readonly palette: boolean; // harmonics are rows of the file's palette
  readonly degree: number;
  readonly levels: number;
  readonly opacityStep: number; // of 1/255
  readonly shBits: readonly [number, number];
  readonly spread: number;
  readonly origin: readonly [number, number, number];
  readonly step: number;
  readonly scaleStep: number;
  readonly colourStep: number;
  readonly scaleOrigin: number;
  readonly colourOrigin: number;
  readonly rotationOrigin: number;
}

/** The header of a stream; throws for another format. */
export function readHeader(bytes: Uint8Array): Header {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (bytes.length < HEADER_BYTES || view.getUint32(0) !== MAGIC) throw new Error("not a sagesplat-stream");
  if (view.getUint8(4) !== VERSION) throw new Error("a stream of another version");
  if (view.getUint8(5) > 7 || view.getUint16(42, true)) throw new Error("a stream with unknown flags");
  const float = (at: number) => view.getFloat32(at, true);
  const header: Header = {
    antialiased: (view.getUint8(5) & 1) > 0,
    twoOpacities: (view.getUint8(5) & 2) > 0,
    palette: (view.getUint8(5) & PALETTE) > 0,
    degree: view.getUint8(6),
    levels: view.getUint8(7),
    opacityStep: view.getUint8(8),
    shBits: [view.getUint8(9), view.getUint8(10)],
    spread: view.getUint8(11),
    origin: [float(12), float(16), float(20)],
    step: float(24),
    scaleStep: float(28),
    colourStep: float(32),
    scaleOrigin: view.getInt16(36, true),
    colourOrigin: view.getInt16(38, true),
    rotationOrigin: view.getInt16(40, true),
  };
  const { step, scaleStep, colourStep, origin, levels, opacityStep, spread, shBits } = header;
  const steps = [step, scaleStep, colourStep].every((s) => s >= 1 / GREATEST && s <= GREATEST);
  const inReach = origin.every((at) => Math.abs(at) + step * 2 ** 17 <= GREATEST);
  const bits = shBits.every((n) => n >= 1 && n <= 8);
  const rows = header.palette && !header.degree;
  if (!steps || !inReach || !bits || rows || header.degree > 3 || !levels || !opacityStep || !spread) {
    throw new Error("a stream with an impossible header");
  }
  return header;
}
