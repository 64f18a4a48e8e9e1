/** The Gaussian process of src/sagesplat/adapt/process.py: its kernel, and weights from values at its views. */

/** Added to the kernel's diagonal; the same as in src/sagesplat/viewer/promises.py. */
const NUGGET = 1e-3;
/** Position, direction, log screen, log field, log distance. */
const INPUTS = 9;

/** Matern 3/2 of the square of a scaled difference. */
export function matern(square: number): number {
  const scaled = Math.sqrt(3 * square);
  return (1 + scaled) * Math.exp(-scaled);
}

/** The lower half of C + NUGGET I for n views, whose inputs [n, INPUTS] are divided by the length scales. */
export function covariance(scaled: Float64Array, n: number): Float64Array {
  const S = new Float64Array(n * n);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j <= i; j++) {
      let square = 0;
      for (let k = 0; k < INPUTS; k++) {
        const apart = (scaled[INPUTS * i + k] as number) - (scaled[INPUTS * j + k] as number);
        square += apart * apart;
      }
      S[i * n + j] = matern(square) + (i === j ? NUGGET : 0);
    }
  }
  return S;
}

/** S^-1 values for each row of values [K, n]; S is given by its lower half, which is overwritten. */
export function solved(S: Float64Array, values: Float64Array, n: number): Float64Array {
  cholesky(S, n);
  for (let row = 0; row < values.length; row += n) {
    for (let i = 0; i < n; i++) {
      let sum = values[row + i] as number;
      for (let j = 0; j < i; j++) sum -= (S[i * n + j] as number) * (values[row + j] as number);
      values[row + i] = sum / (S[i * n + i] as number);
    }
    for (let i = n - 1; i >= 0; i--) {
      const value = (values[row + i] as number) / (S[i * n + i] as number);
      values[row + i] = value;
      for (let j = 0; j < i; j++)
        values[row + j] = (values[row + j] as number) - (S[i * n + j] as number) * value;
    }
  }
  return values;
}

/** The lower Cholesky factor of a symmetric positive definite matrix given by its lower half, in place. */
function cholesky(S: Float64Array, n: number): void {
  for (let i = 0; i < n; i++) {
    for (let j = 0; j <= i; j++) {
      let sum = S[i * n + j] as number;
      for (let k = 0; k < j; k++) sum -= (S[i * n + k] as number) * (S[j * n + k] as number);
      // rounding can make the pivot vanish
      S[i * n + j] = i === j ? Math.sqrt(Math.max(sum, 1e-12)) : sum / (S[j * n + j] as number);
    }
  }
}
