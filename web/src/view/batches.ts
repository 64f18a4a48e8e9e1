import type { SparkRenderer } from "@sparkjsdev/spark";
import { BufferAttribute, InstancedBufferGeometry } from "three";

const BATCH = 64; // splats in an instance
const MARGIN = 1.3; // half pictures from the centre up to which the projection's slope is taken, as in training
const BLUR = "4.0"; // twice by how many pixels the blur may widen a splat
const CORNERS = [
  [-1, -1],
  [1, -1],
  [1, 1],
  [-1, 1],
] as const;

/** What a splat adds to a pixel: Spark's own shader asks each pixel for what none of our splats has. */
const FRAGMENT = `precision highp float;

uniform float minAlpha;
in vec4 vRgba;
in vec2 vSplatUv;
out vec4 fragColor;

void main() {
    float alpha = vRgba.a * exp(-0.5 * dot(vSplatUv, vSplatUv));
    if (alpha < minAlpha) discard;
    fragColor = vec4(vRgba.rgb * alpha, alpha);
}`;

/**
 * Makes Spark draw its splats by the batch, each no larger than where its alpha falls below `minAlpha`. Spark
 * draws an instance for each splat, as large as an opaque one, which takes several times as long on a CPU.
 */
export function drawInBatches(spark: SparkRenderer): void {
  const { material } = spark;
  const count = { value: 0 };
  material.uniforms.drawn = count;
  material.vertexShader = batched(material.vertexShader);
  material.fragmentShader = FRAGMENT;
  const geometry = quads();
  spark.geometry.dispose();
  spark.geometry = geometry;
  const before = spark.onBeforeRender;
  spark.onBeforeRender = (renderer, scene, camera) => {
    before.call(spark, renderer, scene, camera);
    count.value = spark.activeSplats;
    geometry.instanceCount = Math.ceil(count.value / BATCH);
  };
}

/**
 * Spark's vertex shader, for batches. As in training, a splat is drawn wherever it reaches into the picture, and
 * outside of it stretched no more than at its rim; one larger than the largest square is cut off, where Spark
 * squeezes it. Throws for a shader of another version.
 */
export function batched(shader: string): string {
  return [
    ["void main() {", "uniform int drawn;\nuniform bool encodeLinear;\n\nvoid main() {"],
    [
      "    ivec2 orderingCoord = ivec2((gl_InstanceID >> 2) & 4095, gl_InstanceID >> 14);",
      `    int place = gl_InstanceID * ${BATCH} + int(position.z);
    if (place >= drawn) return;
    ivec2 orderingCoord = ivec2((place >> 2) & 4095, place >> 14);`,
    ],
    ["[gl_InstanceID & 3]", "[place & 3]"],
    [
      "    float clip = clipXY * clipCenter.w;\n    if (abs(clipCenter.x) > clip || abs(clipCenter.y) > clip) {",
      `    vec2 lens = vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
    vec2 shift = projectionMatrix[2].xy;
    float widest = adjustedStdDev * max(scales.x, max(scales.y, scales.z));
    vec2 reach = widest * sqrt(lens * lens + sqr(${MARGIN} + length(shift))) + ${BLUR} / renderSize * clipCenter.w;
    if (any(greaterThan(abs(clipCenter.xy) - clipCenter.w, reach))) {`,
    ],
    [
      "vRgba.a = rgba.a;",
      `vRgba.a = rgba.a;
    if (encodeLinear) vRgba.rgb = srgbToLinear(vRgba.rgb);
    adjustedStdDev = min(adjustedStdDev, sqrt(2.0 * log(rgba.a / minAlpha)));`,
    ],
    [
      "vec2 J2 = -(J1 * viewCenter.xy) * invZ;",
      `vec2 J2 = -J1 * clamp(viewCenter.xy * invZ, -(shift + ${MARGIN}) / lens, (${MARGIN} - shift) / lens);`,
    ],
    [
      "vec2 pixelOffset =",
      `vSplatUv = position.xy * vec2(scale1, scale2) / sqrt(vec2(eigen1, eigen2));
    vec2 pixelOffset =`,
    ],
  ].reduce((text, [before = "", after = ""]) => {
    if (text.split(before).length !== 2) throw new Error(`not the shader of Spark 2.2: no ${before}`);
    return text.replace(before, () => after);
  }, shader);
}

/** Squares from -1 to 1 on x and y; z is their number in the batch. */
function quads(): InstancedBufferGeometry {
  const numbers = [...Array(BATCH).keys()];
  const corners = numbers.flatMap((i) => CORNERS.flatMap(([x, y]) => [x, y, i]));
  const geometry = new InstancedBufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(new Float32Array(corners), 3));
  geometry.setIndex(numbers.flatMap((i) => [0, 1, 2, 0, 2, 3].map((corner) => 4 * i + corner)));
  return geometry;
}
