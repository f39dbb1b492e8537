// The newest kept frame of the star camera with its stars and objects; a click or Enter on a line of the list chooses a frame.
export class KeptFrame {
  constructor(figure, list) {
    this.figure = figure;
    [this.image, this.marks, this.words] = ["img", "canvas", "figcaption"].map((name) => figure.querySelector(name));
    this.asked = null; this.picked = null;
    this.image.onload = () => this.mark();
    const pick = (event) => {
      const sequence = event.target.closest("tr")?.dataset.sequence;
      if (sequence !== undefined) { this.picked = Number(sequence); this.ask(this.picked); }
    };
    list.addEventListener("click", pick);
    list.addEventListener("keydown", (event) => { if (event.key === "Enter") pick(event); });
  }
  show(newest, _, __, again) {
    if (again) this.picked = null;
    const sequence = newest.streak?.sequence ?? newest.stars?.sequence;
    if (this.picked === null && sequence !== undefined) this.ask(sequence);
  }
  async ask(sequence) {
    if (sequence === this.asked) return;
    this.asked = sequence;
    const facts = await (await fetch(`/api/frame?sequence=${sequence}`)).json();
    // A frame that was not kept leaves the one before: a flight keeps the newest ones only.
    if (facts === null || sequence !== this.asked) return;
    this.facts = facts;
    this.figure.hidden = false;
    this.image.src = `/api/frame.png?sequence=${sequence}`;
    const rate = facts.rate_rad_s === null ? "" : `, ${(180 / Math.PI * Math.hypot(...facts.rate_rad_s)).toFixed(3)} deg/s`;
    const objects = facts.object_points.length ? `, ${facts.object_points.length} other` : "";
    this.words.textContent = `frame ${sequence}, ${facts.exposure_s} s: ${facts.star_points.length} stars identified${objects}${rate}`;
  }
  mark() {
    const [width, height] = [this.image.naturalWidth, this.image.naturalHeight];
    Object.assign(this.marks, { width, height });
    const pen = this.marks.getContext("2d");
    const scale = width / this.facts.columns;
    pen.lineWidth = 1.5;
    for (const [points, colour, size] of [[this.facts.star_points, "#4cc38a", 7], [this.facts.object_points, "#f0b849", 11]]) {
      pen.strokeStyle = colour;
      for (const [x, y] of points) {
        pen.beginPath();
        pen.arc((x + 0.5) * scale, (y + 0.5) * scale, size, 0, 2 * Math.PI);
        pen.stroke();
      }
    }
  }
}
