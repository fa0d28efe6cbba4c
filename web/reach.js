// How far each motion can go from where the blade is, by the configuration's limits: graderd/core/attitude.py, the other way.
const DEG = 180 / Math.PI;
const MARGIN = { rotate: 0.05, height: 0.5, slope: 0.1, pitch: 0.1 };

/** The end of an axis's travel in one direction (+1, −1), in its unit; null where a position or a limit is not known. */
export function reach(axis, sign, config, status) {
  const end = ends(axis, config, status);
  if (!end || end.some((value) => !Number.isFinite(value))) return null;
  const value = sign > 0 ? Math.max(...end) - MARGIN[axis] : Math.min(...end) + MARGIN[axis];
  return Math.round(value * 1000) / 1000;
}

function ends(axis, { rotation, lift_left, lift_right, tilt, attitude }, { axes, attitude: now }) {
  if (axis === "rotate") return [rotation.min_deg, rotation.max_deg];
  if (axis === "pitch") return [tilt.min_mm, tilt.max_mm].map((mm) => (mm - attitude.tilt_level_mm) * attitude.tilt_deg_per_mm);
  const left = axes.lift_left?.measured ?? NaN, right = axes.lift_right?.measured ?? NaN;
  const raise = (attitude.lift_raises_by_extending ? 1 : -1) * attitude.lift_height_ratio;
  if (axis === "height") {
    const by = [Math.max(lift_left.min_mm - left, lift_right.min_mm - right), Math.min(lift_left.max_mm - left, lift_right.max_mm - right)];
    return by.map((mm) => (now.height_mm ?? NaN) + raise * mm);
  }
  // Slope: as far as one lift goes up while the other goes down.
  const middle = (left + right) / 2;
  const by = [Math.max(lift_left.min_mm - middle, middle - lift_right.max_mm), Math.min(lift_left.max_mm - middle, middle - lift_right.min_mm)];
  return by.map((mm) => Math.atan((2 * raise * mm) / attitude.lift_spacing_mm) * DEG);
}
