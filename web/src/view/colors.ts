import type { Manifest } from "../types";

const STEP = 0.618034; // of shades from cell to cell: neighbours in the list differ

/** The colours of cells by id: those of their labels, or shades of them. */
export const colorsOf = ({ labels }: Manifest, shaded = false): Map<number, string> =>
  new Map(
    labels.flatMap(({ color, cells }) =>
      cells.map(({ id }, i) => [id, shaded ? shade(color, (0.5 + i * STEP) % 1) : color] as const),
    ),
  );

/** A colour as it is at 0.5, darker below and lighter above. */
function shade(color: string, at: number): string {
  const channels = [1, 3, 5].map((i) => Number.parseInt(color.slice(i, i + 2), 16));
  const mixed = channels.map((c) => (at < 0.5 ? c * (0.4 + 1.2 * at) : c + (255 - c) * (1.2 * at - 0.6)));
  return `#${mixed.map((c) => Math.round(c).toString(16).padStart(2, "0")).join("")}`;
}
