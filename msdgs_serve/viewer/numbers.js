// Numbers as people read them.

const UNITS = ["bytes", "kB", "MB", "GB", "TB"];
const DIGITS = 3; // significant ones, where nothing says how many matter
const MAX_DIGITS = 12; // after the point
const TINY = 1e-6; // smaller numbers have an exponent, as have
const HUGE = 1e9; // larger ones
const RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹";

/** 1234567 → "1,234,567" */
export const count = (number) => decimal(number, { maximumFractionDigits: 0 });

/** 0.00421 → "0.00421", 4 → "4", 3.2e-7 → "3.2 × 10⁻⁷" */
export function plain(number) {
  const [digits, exponent] = number.toExponential(DIGITS - 1).split("e");
  const size = Math.abs(number);
  if (size === 0 || (size >= TINY && size < HUGE)) return decimal(number, { maximumSignificantDigits: DIGITS });
  return `${Number(digits)} × 10${raised(Number(exponent))}`;
}

/** A number with the digits that tell a thousandth of `range`: 0.5 of 1 → "0.500" */
export function inRange(number, range) {
  const digits = 3 - Math.floor(Math.log10(range || 1));
  return number.toFixed(Math.min(Math.max(digits, 0), MAX_DIGITS));
}

/** 2781092 → "2.8 MB" */
export function size(bytes) {
  let [amount, unit] = [bytes, 0];
  while (amount >= 999.5 && unit < UNITS.length - 1) [amount, unit] = [amount / 1000, unit + 1];
  const places = unit > 0 && amount < 99.95 ? 1 : 0;
  return `${amount.toFixed(places)} ${UNITS[unit]}`;
}

/** 52.04 → "52.0 dB" */
export const decibels = (psnr) => `${psnr.toFixed(1)} dB`;

/** 0.0017 → "1.7 ms", 0.0148 → "15 ms", 1.234 → "1.23 s" */
export function duration(seconds) {
  if (seconds >= 0.9995) return `${plain(seconds)} s`;
  return `${decimal(1000 * seconds, { maximumFractionDigits: seconds < 0.01 ? 1 : 0 })} ms`;
}

const decimal = (number, options) => new Intl.NumberFormat("en", options).format(number);

const raised = (exponent) => (exponent < 0 ? "⁻" : "") + [...`${Math.abs(exponent)}`].map((digit) => RAISED[digit]).join("");
