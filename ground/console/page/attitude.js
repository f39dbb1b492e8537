// The body in its reference frame, drawn on a canvas: a box with its axes, and the directions that matter.
const COLOURS = { sun: "#ffd75e", nadir: "#4cc38a", velocity: "#c38bff", field: "#5aa9ff", dipole: "#ff6fb1", camera: "#9fb3c8", target: "#8794a6" };
const AXES = ["#ff7b72", "#7ee787", "#79c0ff"];
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
  }

  // Of the testbed the thread, the body's second axis, is up; in orbit the celestial pole.
  seen([x, y, z]) {
    const [a, b, up] = this.table.orbit ? [x, y, z] : [z, x, y];
    const [ca, sa, ch, sh] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.height), Math.sin(this.height)];
    const [right, away] = [ca * b - sa * a, ca * a + sa * b];
    const depth = ch * away + sh * up;
    const scale = this.canvas.height * 0.3 * (4 / (4 - depth));
    return [this.canvas.width / 2 + scale * right, this.canvas.height / 2 - scale * (ch * up - sh * away), depth];
  }

  line(ctx, from, to, colour, width = 2, dash = []) {
    const [a, b] = [this.seen(from), this.seen(to)];
    ctx.strokeStyle = colour; ctx.lineWidth = width; ctx.setLineDash(dash);
    ctx.beginPath(); ctx.moveTo(a[0], a[1]); ctx.lineTo(b[0], b[1]); ctx.stroke(); ctx.setLineDash([]);
    return b;
  }

  arrow(ctx, direction, colour, name, length = 1.35, dash = []) {
    const end = this.line(ctx, [0, 0, 0], direction.map((part) => length * part), colour, 2, dash);
    ctx.fillStyle = colour; ctx.beginPath(); ctx.arc(end[0], end[1], 3.5, 0, 7); ctx.fill();
    ctx.font = "12px sans-serif"; ctx.fillText(name, end[0] + 6, end[1] - 4);
  }

  show(newest, state) {
    const ctx = this.canvas.getContext("2d");
    ctx.clearRect(0, 0, this.canvas.width, this.canvas.height);
    const attitude = newest.attitude;
    const known = attitude && whole(attitude.quaternion);
    const q = known ? attitude.quaternion : [0, 0, 0, 1];
    this.frame(ctx);
    if (state.surroundings) for (const name of ["sun", "nadir", "velocity"]) this.arrow(ctx, state.surroundings[name], COLOURS[name], name, 1.5);
    if (newest.imu && whole(newest.imu.field) && unit(newest.imu.field)) this.arrow(ctx, turned(q, unit(newest.imu.field)), COLOURS.field, "field", 1.2);
    if (attitude && whole(attitude.target)) this.axes(ctx, attitude.target, 1.0, true);
    this.box(ctx, q, known);
    this.axes(ctx, q, 0.85, false);
    if (attitude && whole(attitude.dipole) && Math.hypot(...attitude.dipole) > 1e-7) this.arrow(ctx, turned(q, unit(attitude.dipole)), COLOURS.dipole, "dipole", 1.05);
    if (this.table.camera) this.camera(ctx, q);
    if (!known) { ctx.fillStyle = "#ffb454"; ctx.font = "14px sans-serif"; ctx.fillText("attitude not known", 14, 24); }
    this.legend.textContent = words(attitude, known);
  }

  frame(ctx) {
    const names = ["x", "y", "z"];
    for (let k = 0; k < 3; k++) {
      const end = [0, 0, 0]; end[k] = 1.75;
      const tip = this.line(ctx, [0, 0, 0], end, "#303b4a", 1);
      ctx.fillStyle = "#5b6878"; ctx.font = "11px sans-serif"; ctx.fillText(names[k], tip[0] + 3, tip[1]);
    }
  }

  axes(ctx, q, length, ghost) {
    for (let k = 0; k < 3; k++) {
      const axis = [0, 0, 0]; axis[k] = length;
      this.line(ctx, [0, 0, 0], turned(q, axis), ghost ? COLOURS.target : AXES[k], ghost ? 1 : 3, ghost ? [4, 4] : []);
    }
  }

  box(ctx, q, known) {
    const corners = [...Array(8).keys()].map((k) => turned(q, [k & 4 ? 0.5 : -0.5, k & 2 ? 0.5 : -0.5, k & 1 ? 0.5 : -0.5]));
    const seen = corners.map((corner) => this.seen(corner));
    const faces = FACES.map((face, k) => [face, k, face.reduce((sum, corner) => sum + seen[corner][2], 0)]).sort((a, b) => a[2] - b[2]);
    for (const [face, k, depth] of faces) {
      const shade = 38 + 22 * (depth / 4 + 0.5);
      ctx.fillStyle = known ? `hsla(${[215, 205, 225][k >> 1]}, 35%, ${shade}%, 0.82)` : "rgba(90, 100, 112, 0.4)";
      ctx.strokeStyle = "#0b0f14"; ctx.lineWidth = 1;
      ctx.beginPath(); face.forEach((corner, n) => ctx[n ? "lineTo" : "moveTo"](seen[corner][0], seen[corner][1])); ctx.closePath(); ctx.fill(); ctx.stroke();
    }
  }

  camera(ctx, q) {
    const [mounting, field] = this.table.camera;
    const [reach, half] = [1.3, Math.tan(field / 2)];
    const rim = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([a, b]) => turned(q, turned(mounting, [reach * half * a, reach * half * b, reach])));
    rim.forEach((corner, k) => { this.line(ctx, [0, 0, 0], corner, COLOURS.camera, 1); this.line(ctx, corner, rim[(k + 1) % 4], COLOURS.camera, 1); });
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
