// The ground track on a map with day and night. Land: Natural Earth, as TopoJSON.
import { colour } from "/page/theme.js";

// Return the rings of the land. An arc consists of integer steps from one point to the next.
function rings(topology) {
  const { scale, translate } = topology.transform;
  const arcs = topology.arcs.map((arc) => {
    let [x, y] = [0, 0];
    return arc.map(([dx, dy]) => [(x += dx) * scale[0] + translate[0], (y += dy) * scale[1] + translate[1]]);
  });
  const shapes = topology.objects.land.geometries.flatMap((shape) => (shape.type === "Polygon" ? [shape.arcs] : shape.arcs));
  return shapes.flat().map((ring) => ring.flatMap((k) => (k < 0 ? [...arcs[~k]].reverse() : arcs[k])));
}

export class GroundTrack {
  constructor(canvas, words) {
    this.canvas = canvas; this.words = words; this.land = []; this.track = []; this.asked = -Infinity;
    fetch("/page/vendor/land-110m.json").then((answer) => answer.json()).then((topology) => { this.land = rings(topology); });
  }

  at(latitude, longitude) { return [(longitude + 180) / 360 * this.canvas.width, (90 - latitude) / 180 * this.canvas.height]; }

  show(_, state) {
    const place = state.surroundings;
    if (!place) { this.words.textContent = "the position is not known"; return; }
    if (Math.abs(state.time - this.asked) > 60) {
      this.asked = state.time;
      fetch(`/api/track?at=${state.time}`).then((answer) => answer.json()).then((answer) => { this.track = answer.track ?? []; });
    }
    const ctx = this.canvas.getContext("2d");
    ctx.fillStyle = colour("sea"); ctx.fillRect(0, 0, this.canvas.width, this.canvas.height);
    ctx.fillStyle = colour("land");
    for (const ring of this.land) { ctx.beginPath(); ring.forEach(([x, y], k) => ctx[k ? "lineTo" : "moveTo"](...this.at(y, x))); ctx.fill(); }
    this.night(ctx, place);
    ctx.strokeStyle = colour("accent"); ctx.lineWidth = 1.2; ctx.beginPath();
    this.track.forEach(([latitude, longitude], k) => {
      const jump = k === 0 || Math.abs(longitude - this.track[k - 1][1]) > 180;
      ctx[jump ? "moveTo" : "lineTo"](...this.at(latitude, longitude));
    });
    ctx.stroke();
    this.dot(ctx, place.sun_latitude, place.sun_longitude, colour("sun"), 7);
    this.dot(ctx, place.latitude, place.longitude, colour("dipole"), 5);
    const light = place.sunlit > 0.99 ? "in sunlight" : place.sunlit < 0.01 ? "in the Earth's shadow" : "in penumbra";
    this.words.textContent = `${place.latitude.toFixed(2)}°, ${place.longitude.toFixed(2)}°, ${place.altitude_km.toFixed(0)} km, ${light}`;
  }

  // The night side lies beyond the great circle perpendicular to the direction of the Sun.
  night(ctx, { sun_latitude: latitude, sun_longitude: longitude }) {
    const slope = Math.tan(Math.max(Math.abs(latitude), 0.05) * Math.PI / 180) * (latitude < 0 ? -1 : 1);
    ctx.fillStyle = colour("night"); ctx.beginPath();
    for (let k = -180; k <= 180; k += 2) {
      const edge = Math.atan(-Math.cos((k - longitude) * Math.PI / 180) / slope) * 180 / Math.PI;
      ctx[k === -180 ? "moveTo" : "lineTo"](...this.at(edge, k));
    }
    const pole = latitude > 0 ? -90 : 90;
    ctx.lineTo(...this.at(pole, 180)); ctx.lineTo(...this.at(pole, -180)); ctx.fill();
  }

  dot(ctx, latitude, longitude, colour, radius) {
    ctx.fillStyle = colour; ctx.beginPath(); ctx.arc(...this.at(latitude, longitude), radius, 0, 7); ctx.fill();
  }
}
