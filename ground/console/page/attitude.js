// The body in its reference frame, drawn on a canvas: a box with its axes and coils, and directions such as that of the Sun.
import { colour } from "/page/theme.js";

const AXES = ["curve2", "curve3", "curve1"];
const KEY_STEPS = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] };
const FACES = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

// Turns v by the unit quaternion q, scalar last: a vector of body axes into reference axes.
export function turned(q, v) {
  const [x, y, z, w] = q;
  const t = [2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])];
  return [v[0] + w * t[0] + y * t[2] - z * t[1], v[1] + w * t[1] + z * t[0] - x * t[2], v[2] + w * t[2] + x * t[1] - y * t[0]];
}
const unit = (v) => { const n = Math.hypot(...v); return n > 0 ? v.map((part) => part / n) : null; };
const whole = (v) => Array.isArray(v) && v.every((part) => part !== null);

export class Attitude {
  constructor(canvas, legend, table) {
    this.canvas = canvas; this.legend = legend; this.table = table;
    this.azimuth = 0.7; this.height = 0.4;
    let last = null;
    canvas.onpointerdown = (event) => { last = [event.clientX, event.clientY]; canvas.setPointerCapture(event.pointerId); };
    canvas.onpointermove = (event) => {
      if (!last) return;
      this.azimuth -= 0.01 * (event.clientX - last[0]);
      this.height = Math.max(-1.5, Math.min(1.5, this.height + 0.01 * (event.clientY - last[1])));
      last = [event.clientX, event.clientY];
    };
    canvas.onpointerup = () => { last = null; };
    canvas.onkeydown = (event) => {
      const step = KEY_STEPS[event.key];
      if (!step) return;
      event.preventDefault();
      this.azimuth += step[0];
      this.height = Math.max(-1.5, Math.min(1.5, this.height + step[1]));
    };
  }

  // Up is the thread of a testbed, the second body axis, and the celestial pole in orbit.
  seen([x, y, z]) {
    const [a, b, up] = this.table.orbit ? [x, y, z] : [z, x, y];
    const [ca, sa, ch, sh] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.height), Math.sin(this.height)];
    const [right, away] = [ca * b - sa * a, ca * a + sa * b];
    const depth = ch * away + sh * up;
    const scale = this.canvas.height * 0.28 * (4 / (4 - depth));
    return [this.canvas.width / 2 + scale * right, this.canvas.height / 2 - scale * (ch * up - sh * away), depth];
  }

  line(ctx, from, to, colour, width = 2, dash = []) {
    const [a, b] = [this.seen(from), this.seen(to)];
    ctx.strokeStyle = colour; ctx.lineWidth = width; ctx.setLineDash(dash);
    ctx.beginPath(); ctx.moveTo(a[0], a[1]); ctx.lineTo(b[0], b[1]); ctx.stroke(); ctx.setLineDash([]);
    return b;
  }

  // An arrow that points away from the reader is drawn behind the box, and its name in front.
  arrows(ctx, arrows, near) {
    for (const { direction, colour, length } of arrows) {
      const tip = direction.map((part) => length * part);
      if ((this.seen(tip)[2] > 0) !== near) continue;
      const end = this.line(ctx, [0, 0, 0], tip, colour);
      ctx.fillStyle = colour; ctx.beginPath(); ctx.arc(end[0], end[1], 3.5, 0, 7); ctx.fill();
    }
  }

  names(ctx, arrows) {
    const taken = [];
    ctx.font = "12px sans-serif";
    for (const { direction, colour, length, name } of arrows) {
      const [x, y] = this.seen(direction.map((part) => length * part));
      const wide = ctx.measureText(name).width;
      const left = Math.max(2, Math.min(this.canvas.width - wide - 2, x + 6));
      let low = Math.max(12, Math.min(this.canvas.height - 4, y - 4));
      while (taken.some(([a, b, w]) => Math.abs(b - low) < 13 && left < a + w && a < left + wide)) low += 13;
      taken.push([left, low, wide]);
      ctx.fillStyle = colour; ctx.fillText(name, left, low);
    }
  }

  show(newest, state) {
    const ctx = this.canvas.getContext("2d");
    ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
    const attitude = newest.attitude;
    const known = attitude && whole(attitude.quaternion);
    const q = known ? attitude.quaternion : [0, 0, 0, 1];
    const arrows = this.arrowsOf(newest, state.surroundings, q);
    this.frame(ctx);
    this.arrows(ctx, arrows, false);
    if (attitude && whole(attitude.target)) this.axes(ctx, attitude.target, 1.0, true);
    this.box(ctx, q, known);
    this.axes(ctx, q, 0.85, false);
    if (attitude && whole(attitude.dipole)) this.coils(ctx, q, attitude.dipole);
    if (this.table.camera) this.camera(ctx, q);
    this.arrows(ctx, arrows, true);
    this.names(ctx, arrows);
    if (!known) { ctx.fillStyle = colour("warn"); ctx.font = "14px sans-serif"; ctx.fillText("attitude not known", 14, 24); }
    this.legend.textContent = [words(attitude, known), ...this.sight(q, known, state.surroundings)].join(" · ");
  }

  // In orbit the field is that of the model, because the magnetometer also measures the coils.
  arrowsOf({ attitude, imu }, place, q) {
    const arrows = [];
    const add = (name, direction, length) => { if (direction) arrows.push({ name, direction, length, colour: colour(name) }); };
    if (place) for (const name of ["sun", "nadir", "velocity"]) add(name, place[name], 1.4);
    if (place?.field_t) add("field", unit(place.field_t), 1.2);
    else if (imu && whole(imu.field)) add("field", unit(imu.field) && turned(q, unit(imu.field)), 1.2);
    if (attitude && whole(attitude.dipole) && Math.hypot(...attitude.dipole) > 1e-7) add("dipole", turned(q, unit(attitude.dipole)), 1.05);
    return arrows;
  }

  // Each coil is a ring on its face, and its dipole moment a bar, which has the width of the body at the limit of the coil.
  coils(ctx, q, dipole) {
    const most = this.table.coil_dipole ?? Math.max(...dipole.map(Math.abs), 1e-9);
    for (let k = 0; k < 3; k++) {
      const ring = [...Array(25).keys()].map((n) => {
        const point = [0, 0, 0]; point[k] = 0.5; point[(k + 1) % 3] = 0.4 * Math.cos(n * Math.PI / 12); point[(k + 2) % 3] = 0.4 * Math.sin(n * Math.PI / 12);
        return this.seen(turned(q, point));
      });
      ctx.strokeStyle = colour("dipole"); ctx.lineWidth = 0.8; ctx.globalAlpha = 0.45; ctx.beginPath();
      ring.forEach(([x, y], n) => ctx[n ? "lineTo" : "moveTo"](x, y)); ctx.stroke(); ctx.globalAlpha = 1;
      const [from, to] = [[0, 0, 0], [0, 0, 0]]; from[k] = 0.5; to[k] = 0.5 + dipole[k] / most;
      this.line(ctx, turned(q, from), turned(q, to), colour("dipole"), 4);
    }
  }

  frame(ctx) {
    const names = ["x", "y", "z"];
    for (let k = 0; k < 3; k++) {
      const end = [0, 0, 0]; end[k] = 1.75;
      const tip = this.line(ctx, [0, 0, 0], end, colour("line"), 1);
      ctx.fillStyle = colour("dim"); ctx.font = "11px sans-serif"; ctx.fillText(names[k], tip[0] + 3, tip[1]);
    }
  }

  axes(ctx, q, length, ghost) {
    for (let k = 0; k < 3; k++) {
      const axis = [0, 0, 0]; axis[k] = length;
      this.line(ctx, [0, 0, 0], turned(q, axis), ghost ? colour("target") : colour(AXES[k]), ghost ? 1 : 3, ghost ? [4, 4] : []);
    }
  }

  box(ctx, q, known) {
    const corners = [...Array(8).keys()].map((k) => turned(q, [k & 4 ? 0.5 : -0.5, k & 2 ? 0.5 : -0.5, k & 1 ? 0.5 : -0.5]));
    const seen = corners.map((corner) => this.seen(corner));
    const faces = FACES.map((face, k) => [face, k, face.reduce((sum, corner) => sum + seen[corner][2], 0)]).sort((a, b) => a[2] - b[2]);
    for (const [face, k, depth] of faces) {
      const shade = 38 + 22 * (depth / 4 + 0.5);
      ctx.fillStyle = known ? `hsla(${[215, 205, 225][k >> 1]}, 35%, ${shade}%, 0.82)` : "rgba(90, 100, 112, 0.4)";
      ctx.strokeStyle = colour("drawing"); ctx.lineWidth = 1;
      ctx.beginPath(); face.forEach((corner, n) => ctx[n ? "lineTo" : "moveTo"](seen[corner][0], seen[corner][1])); ctx.closePath(); ctx.fill(); ctx.stroke();
    }
  }

  // Direction of the star camera in ICRS and its angle from the Sun; the reference frame of a testbed is not ICRS.
  sight(q, known, place) {
    if (!known || !place || !this.table.camera) return [];
    const axis = turned(q, turned(this.table.camera[0], [0, 0, 1]));
    const degrees = 180 / Math.PI;
    const right = (Math.atan2(axis[1], axis[0]) * degrees + 360) % 360;
    const off = Math.acos(Math.max(-1, Math.min(1, axis.reduce((sum, part, k) => sum + part * place.sun[k], 0)))) * degrees;
    return [`camera at ${right.toFixed(1)}°, ${(Math.asin(Math.max(-1, Math.min(1, axis[2]))) * degrees).toFixed(1)}° (ICRS), ${off.toFixed(0)}° off the Sun`];
  }

  camera(ctx, q) {
    const [mounting, field] = this.table.camera;
    const [reach, half] = [1.3, Math.tan(field / 2)];
    const rim = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => turned(q, turned(mounting, [reach * half * a, reach * half * b, reach])));
    rim.forEach((corner, k) => { this.line(ctx, [0, 0, 0], corner, colour("camera"), 1); this.line(ctx, corner, rim[(k + 1) % 4], colour("camera"), 1); });
  }
}

function words(attitude, known) {
  if (!known) return "no estimate of the attitude";
  const degrees = (value) => value * 180 / Math.PI;
  const parts = [];
  if (whole(attitude.rate)) parts.push(`rate ${degrees(Math.hypot(...attitude.rate)).toFixed(3)} deg/s`);
  if (whole(attitude.angle_sigma)) parts.push(`known to ${degrees(Math.max(...attitude.angle_sigma)).toPrecision(2)} deg (1 sigma, worst axis)`);
  if (whole(attitude.target)) {
    const dot = Math.abs(attitude.target.reduce((sum, part, k) => sum + part * attitude.quaternion[k], 0));
    parts.push(`${degrees(2 * Math.acos(Math.min(1, dot))).toFixed(2)} deg off the target`);
  }
  return parts.join(" · ");
}
