// A direction of up in the words of the fixture's faces, as a cube that stands so, and
// the directions of a unit on a sphere. The words are those of station/faces.py.

import { svg, word } from "./common.js";

const STEP_DEG = 5;
const SAME_BEARING_DEG = 1;
const AXES = ["x", "y", "z"];

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const minus = (a, b, times = 1) => a.map((v, i) => v - times * b[i]);
const norm = (a) => Math.sqrt(dot(a, a));
const unit = (a) => a.map((v) => v / norm(a));
const degrees = (radians) => (radians * 180) / Math.PI;

/** Six faces, eight corners and twelve edges of a cube, in this order: the axes (one
 * to three) and the direction of each. */
const CUBE = (() => {
  const found = [];
  for (const x of [1, 0, -1]) for (const y of [1, 0, -1]) for (const z of [1, 0, -1]) found.push([x, y, z]);
  const faces = (v) => v.filter(Boolean).length;
  const order = { 1: 0, 3: 1, 2: 2 };
  return found
    .filter(faces)
    .sort((a, b) => order[faces(a)] - order[faces(b)])
    .map((v) => ({ axes: AXES.flatMap((a, i) => (v[i] ? [(v[i] < 0 ? "-" : "+") + a] : [])), up: unit(v) }));
})();

function nearbyDeg(a, b) {
  return STEP_DEG * halfToEven(degrees(Math.atan2(norm(cross(a, b)), dot(a, b))) / STEP_DEG);
}

function halfToEven(value) {
  const floor = Math.floor(value);
  return value - floor === 0.5 ? floor + (floor % 2) : Math.round(value);
}

/** Number of the face, edge or corner in whose bearing `up` lies, seen from `here`. */
function towards(here, up) {
  const way = unit(minus(up, here, dot(up, here)));
  let best = null;
  CUBE.forEach(({ axes, up: other }, i) => {
    const cosine = dot(other, here);
    let off = Infinity;
    if (cosine > -1e-9 && cosine < 1 - 1e-9) {
      const aside = unit(minus(other, here, cosine));
      const angle = degrees(Math.acos(Math.min(1, Math.max(-1, dot(aside, way)))));
      off = halfToEven(angle / SAME_BEARING_DEG);
    }
    const key = [off, axes.length, -cosine];
    if (best === null || key.some((v, k) => v < best.key[k] && key.slice(0, k).every((w, j) => w === best.key[j]))) {
      best = { key, i };
    }
  });
  return best.i;
}

/** The parts of a direction of `up` [3]: the nearest face, edge or corner by its axes,
 * and the tilt from there towards another one. */
export function partsOf(up) {
  up = unit(up);
  let nearest = 0;
  CUBE.forEach(({ up: other }, i) => {
    if (dot(other, up) > dot(CUBE[nearest].up, up) + 1e-9) nearest = i;
  });
  const tilt_deg = nearbyDeg(CUBE[nearest].up, up);
  return {
    axes: CUBE[nearest].axes,
    tilt_deg,
    towards: tilt_deg ? CUBE[towards(CUBE[nearest].up, up)].axes : null,
  };
}

const KINDS = [null, "face", "edge", "corner"];
const UP = { face: "pose.face_up", edge: "pose.edge_up", corner: "pose.corner_up" };
const TOWARDS = { face: "pose.towards_face", edge: "pose.towards_edge", corner: "pose.towards_corner" };

/** A direction in the reader's language: the pose, and the tilt or null. */
export function describedPose(up, faces) {
  const parts = partsOf(up);
  // A minus sign, since a line may break behind a hyphen.
  const named = (axes) => axes.map((a) => faces[a].replace(/^-/, "−")).join("/");
  return {
    pose: word(UP[KINDS[parts.axes.length]], { name: named(parts.axes) }),
    tilt: parts.towards
      ? word(TOWARDS[KINDS[parts.towards.length]], { deg: parts.tilt_deg, name: named(parts.towards) })
      : null,
  };
}

export const OWN_NAMES = Object.fromEntries(AXES.flatMap((a) => [["+" + a, "+" + a.toUpperCase()], ["-" + a, "-" + a.toUpperCase()]]));

// The cube.

const ELEVATION = (28 * Math.PI) / 180;

/** Rows of a rotation that takes the cube's axes to the picture's: right, up, towards
 * the reader. The cube stands with `up` up, turned by `azimuth` about it. */
function view(up, azimuth) {
  const aside = Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const e1 = unit(cross(aside, up));
  const e2 = cross(up, e1);
  const [c, s] = [Math.cos(azimuth), Math.sin(azimuth)];
  const right = e1.map((v, i) => c * v + s * e2[i]);
  const away = e2.map((v, i) => c * v - s * e1[i]);
  const reader = away.map((v, i) => -v * Math.cos(ELEVATION) + up[i] * Math.sin(ELEVATION));
  const top = away.map((v, i) => v * Math.sin(ELEVATION) + up[i] * Math.cos(ELEVATION));
  return [right, top, reader];
}

/** The azimuth from which the faces that are named can be read best. */
function bestView(up, named) {
  let best = null;
  for (let i = 0; i < 72; i += 1) {
    const rows = view(up, (i * Math.PI) / 36);
    let score = 0;
    for (const axis of Object.keys(OWN_NAMES)) {
      const seen = dot(normal(axis), rows[2]);
      if (seen > 0.12) score += (named.includes(axis) ? 3 : 1) * Math.sqrt(seen);
      else if (named.includes(axis)) score -= 1;
    }
    if (best === null || score > best.score + 1e-6) best = { score, rows };
  }
  return best.rows;
}

function normal(axis) {
  return AXES.map((a) => (a === axis[1] ? (axis[0] === "-" ? -1 : 1) : 0));
}

/** Four corners of a face, in turn. */
function cornersOf(axis) {
  const n = normal(axis);
  const [u, v] = [[1, 2, 0], [2, 0, 1]].map((order) => AXES.map((_, i) => Math.abs(n[order[i]])));
  return [[1, 1], [-1, 1], [-1, -1], [1, -1]].map(([p, q]) => n.map((w, i) => w + p * u[i] + q * v[i]));
}

/** A cube with the names of its faces that stands with `up` up; what is to be put up
 * is highlighted. */
export function cubePicture(up, faces, label) {
  up = unit(up);
  const { axes } = partsOf(up);
  const rows = bestView(up, axes);
  const SCALE = 62;
  const at = (p) => [dot(p, rows[0]) * SCALE, -dot(p, rows[1]) * SCALE];
  const points = (list) => list.map((p) => at(p).map((v) => v.toFixed(1)).join(",")).join(" ");
  const picture = svg("svg", { viewBox: "-150 -132 300 264", role: "img", "aria-label": label, class: "cube" });
  const low = Math.max(...CUBE.filter((c) => c.axes.length === 3).map((c) => at(c.up.map((v) => v * Math.sqrt(3)))[1]));
  picture.append(svg("ellipse", { cx: 0, cy: (low - 6).toFixed(1), rx: 92, ry: 20, class: "ground" }));
  const visible = Object.keys(OWN_NAMES).filter((axis) => dot(normal(axis), rows[2]) > 0.02);
  for (const axis of visible) {
    const raised = dot(normal(axis), up);
    const kind = axes.length === 1 && axes[0] === axis ? "face put-up" : `face ${raised > 0.3 ? "top" : raised < -0.3 ? "under" : "side"}`;
    picture.append(svg("polygon", { points: points(cornersOf(axis)), class: kind }));
  }
  if (axes.length === 2) {
    const middle = normal(axes[0]).map((v, i) => v + normal(axes[1])[i]);
    const along = AXES.map((a) => (axes.some((axis) => axis[1] === a) ? 0 : 1));
    const ends = [1, -1].map((s) => at(middle.map((v, i) => v + s * along[i])));
    picture.append(svg("line", { x1: ends[0][0], y1: ends[0][1], x2: ends[1][0], y2: ends[1][1], class: "put-up" }));
  }
  if (axes.length === 3) {
    const [x, y] = at(axes.map(normal).reduce((a, b) => a.map((v, i) => v + b[i])));
    picture.append(svg("circle", { cx: x, cy: y, r: 11, class: "put-up" }));
  }
  for (const axis of visible) picture.append(nameOn(axis, faces[axis], rows, at, axes.length === 1 && axes[0] === axis));
  picture.append(arrow(-122, 60, "g"));
  return picture;
}

/** The name of a face, lying on it, as upright as it goes. */
function nameOn(axis, name, rows, at, putUp) {
  const n = normal(axis);
  const others = AXES.map((_, i) => i).filter((i) => n[i] === 0);
  let best = null;
  for (const [i, j] of [others, [...others].reverse()]) {
    for (const p of [1, -1]) for (const q of [1, -1]) {
      const right = AXES.map((_, k) => (k === i ? p : 0));
      const down = AXES.map((_, k) => (k === j ? q : 0));
      // Not mirrored: right × down leads into the face, as on paper.
      if (dot(cross(right, down), n) > 0) continue;
      const upright = dot(rows[0], right) - 1.2 * dot(rows[1], down);
      if (best === null || upright > best.upright) best = { right, down, upright };
    }
  }
  const [origin, x, y] = [at(n), at(best.right), at(best.down)];
  const length = [...name].length;
  const size = Math.min(0.95, 1.7 / (length * 0.7));
  const matrix = [...x, ...y, ...origin].map((v) => v.toFixed(3)).join(" ");
  return svg("text", {
    transform: `matrix(${matrix})`, "font-size": size.toFixed(3), y: (size * 0.36).toFixed(3), "text-anchor": "middle",
    class: putUp ? "name put-up" : "name",
  }, name);
}

function arrow(x, length, name) {
  return svg("g", { class: "gravity" },
    svg("path", { d: `M${x} ${-length / 2}V${length / 2}m-9 -12 9 13 9-13` }),
    svg("text", { x: x - 15, y: 6, "text-anchor": "middle" }, name));
}

/** A supply that is to be switched off or on. */
export function supplyPicture(on, label) {
  return svg("svg", { viewBox: "-150 -132 300 264", role: "img", "aria-label": label, class: `cube supply ${on ? "on" : "off"}` },
    svg("circle", { r: 84, class: "ring" }),
    on ? svg("path", { d: "M0 -44V44", class: "sign" }) : svg("circle", { r: 40, class: "sign" }));
}

/** A code that is to be scanned. */
export function barcodePicture() {
  const picture = svg("svg", { viewBox: "-150 -132 300 264", "aria-hidden": "true", class: "cube barcode" });
  let x = -90;
  for (const width of [6, 3, 10, 3, 5, 12, 3, 6, 3, 10, 5, 3, 8, 3, 6]) {
    picture.append(svg("rect", { x, y: -52, width, height: 104 }));
    x += width + 6.5;
  }
  picture.append(svg("path", { d: "M-120 -46V-82H-84M84 -82H120V-46M120 46V82H84M-84 82H-120V46" }));
  return picture;
}

// The sphere.

const LOOK = (() => {
  const reader = unit([1, -0.55, 0.5]);
  const right = unit(cross([0, 0, 1], reader));
  return [right, cross(reader, right), reader];
})();

/** Directions of up in a unit's axes: poses taken and missing, and the present one.
 * Those on the far side are drawn paler. */
export function spherePicture({ taken, missing, up, next }, label) {
  const picture = svg("svg", { viewBox: "-66 -66 132 132", role: "img", "aria-label": label, class: "sphere" });
  const at = (v) => [dot(v, LOOK[0]) * 50, -dot(v, LOOK[1]) * 50, dot(v, LOOK[2])];
  picture.append(svg("circle", { r: 50, class: "ball" }));
  for (const plane of [0, 1, 2]) picture.append(svg("path", { d: circleIn(plane, at), class: "grid" }));
  AXES.forEach((name, i) => {
    const v = AXES.map((_, k) => (k === i ? 1 : 0));
    const [x, y] = at(v);
    const length = Math.hypot(x, y) || 1;
    picture.append(svg("text", { x: x + (x / length) * 11, y: y + (y / length) * 11 + 3, "text-anchor": "middle", class: "axis" }, name));
  });
  const points = [
    ...missing.map((v) => ({ v, kind: "missing" })),
    ...taken.map((v) => ({ v, kind: "taken" })),
  ].map(({ v, kind }) => ({ kind, p: at(v) })).sort((a, b) => a.p[2] - b.p[2]);
  for (const { kind, p } of points) {
    picture.append(svg("circle", { cx: p[0].toFixed(1), cy: p[1].toFixed(1), r: kind === "taken" ? 4.2 : 3.6, class: `${kind}${p[2] < 0 ? " far" : ""}` }));
  }
  if (next) {
    const p = at(unit(next));
    picture.append(svg("circle", { cx: p[0].toFixed(1), cy: p[1].toFixed(1), r: 8, class: `next${p[2] < 0 ? " far" : ""}` }));
  }
  if (up) {
    const p = at(up);
    picture.append(
      svg("line", { x1: 0, y1: 0, x2: p[0].toFixed(1), y2: p[1].toFixed(1), class: `now${p[2] < 0 ? " far" : ""}` }),
      svg("path", { d: "M-6 0H6M0 -6V6", transform: `translate(${p[0].toFixed(1)} ${p[1].toFixed(1)})`, class: "now" }));
  }
  return picture;
}

function circleIn(plane, at) {
  const points = [];
  for (let i = 0; i <= 48; i += 1) {
    const [c, s] = [Math.cos((i * Math.PI) / 24), Math.sin((i * Math.PI) / 24)];
    const v = [[0, c, s], [c, 0, s], [c, s, 0]][plane];
    points.push(at(v).slice(0, 2).map((w) => w.toFixed(1)).join(" "));
  }
  return `M${points.join("L")}`;
}
