"use strict";
// Helpers for elements, numbers and curves. page.js follows in the same script and builds the page with them, from the
// JSON in the page. Everything that comes from a run is inserted as text, never as HTML.
const data = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);

function make(namespace, tag, attributes, children) {
  const element = document.createElementNS(namespace, tag);
  for (const [name, value] of Object.entries(attributes))
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (value !== false && value != null) element.setAttribute(name, value === true ? "" : value);
  element.append(...children.flat(Infinity).filter((child) => child != null));
  return element;
}
const html = (tag, attributes = {}, ...children) => make("http://www.w3.org/1999/xhtml", tag, attributes, children);
const svg = (tag, attributes = {}, ...children) => make("http://www.w3.org/2000/svg", tag, attributes, children);
function coloured(element, label) {
  element.style.setProperty("--line", data.labels.find((each) => each.name === label).colour);
  return element;
}

// Numbers

const places = (value) => (Math.abs(value) >= 10 ? 1 : Math.abs(value) >= 1 ? 2 : 3);
const plain = (value, digits = places(value)) => (value == null ? "–" : value.toFixed(digits));
const percent = (value) => (value == null ? "–" : `${(100 * value).toFixed(0)} %`);
const whole = (value) => (value == null ? "?" : value.toLocaleString("en"));
const plural = (count, what) => `${whole(count)} ${what}${count === 1 ? "" : "s"}`;
function withError(mean, sem, rate) {
  if (mean == null) return "–";
  if (rate) return percent(mean) + (sem == null ? "" : ` ± ${(100 * sem).toFixed(0)}`);
  const digits = places(Math.max(Math.abs(mean), sem ?? 0));
  return plain(mean, digits) + (sem == null ? "" : ` ± ${plain(sem, digits)}`);
}
function duration(seconds) {
  if (seconds == null) return "unknown";
  const two = (value) => String(Math.floor(value)).padStart(2, "0");
  if (seconds < 60) return `${seconds.toFixed(0)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)}:${two(seconds % 60)} min`;
  return `${Math.floor(seconds / 3600)}:${two((seconds / 60) % 60)} h`;
}

// Curves

// Lines of one agent with different settings have different dashes, too
const DASHES = ["", "7 4", "2 3", "8 3 2 3", "12 4"];
const dashes = (label) => DASHES[data.labels.find((each) => each.name === label).dash % DASHES.length];
function swatch(label) {
  const line = svg("line", { x1: 0, y1: 5, x2: 22, y2: 5, class: "mean", "stroke-dasharray": dashes(label) });
  return coloured(svg("svg", { width: 22, height: 10, class: "swatch", "aria-hidden": true }, line), label);
}

const MARGIN = { top: 8, right: 18, bottom: 34, left: 54 };
const HEIGHT = 260;

function ticks(low, high, about) {
  const raw = (high - low) / about || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw);
  const first = Math.ceil(low / step - 1e-9);
  const count = Math.floor(high / step + 1e-9) - first + 1;
  return Array.from({ length: Math.max(count, 0) }, (_, index) => +((first + index) * step).toPrecision(12));
}
// All digits of a tick, since ticks that are close to each other must differ
function short(value) {
  if (Math.abs(value) >= 1e6) return `${+(value / 1e6).toPrecision(12)}M`;
  return Math.abs(value) >= 1e4 ? `${+(value / 1e3).toPrecision(12)}k` : String(value);
}

// An SVG path "M x,y L x,y ..." with gaps where a value is missing
function path(points) {
  let pen = "M";
  return points
    .map(([x, y]) => {
      const piece = y == null ? "" : `${pen}${x.toFixed(1)},${y.toFixed(1)}`;
      pen = y == null ? "M" : "L";
      return piece;
    })
    .join("");
}

class Panel {
  constructor(task) {
    this.task = task;
    this.groups = data.groups.filter((group) => group.task === task);
    this.abscissa = this.groups[0].axis; // with action repeat: steps of the agent
    this.tip = html("div", { class: "tip", role: "status" });
    this.plot = svg("svg", {
      tabindex: 0,
      role: "img",
      height: HEIGHT,
      onpointermove: (event) => this.point(this.nearest(event)),
      onpointerdown: (event) => this.point(this.nearest(event)),
      onpointerleave: (event) => event.pointerType !== "touch" && this.point(null),
      onblur: () => this.point(null),
      onkeydown: (event) => this.key(event),
    });
    this.figure = html("figure", { class: "panel" }, html("figcaption", {}, task), this.plot, this.tip);
    new ResizeObserver(() => this.plot.clientWidth !== this.width && this.draw()).observe(this.plot);
  }

  update(view) {
    this.view = view;
    this.lines = this.groups
      .filter(view.group)
      .map((group) => ({ label: group.label, curve: group.curves[view.name] }));
    this.lines = this.lines.filter(({ curve }) => curve && curve.mean.some((value) => value != null));
    this.figure.hidden = !this.lines.length;
    this.steps = [...new Set(this.lines.flatMap(({ curve }) => curve.steps))].sort((a, b) => a - b);
    this.draw();
  }

  draw() {
    this.point(null);
    this.width = this.plot.clientWidth;
    if (!this.width || !this.lines.length) return;
    let [low, high] = this.view.rate ? [0, 1] : this.range();
    if (low === high) [low, high] = [low - 1, high + 1];
    const room = (high - low) * 0.04;
    const last = this.steps.at(-1) || 1;
    const inside = { width: this.width - MARGIN.left - MARGIN.right, height: HEIGHT - MARGIN.top - MARGIN.bottom };
    this.x = (step) => MARGIN.left + (step / last) * inside.width;
    this.y = (value) =>
      value == null ? null : MARGIN.top + (1 - (value - low + room) / (high - low + 2 * room)) * inside.height;
    this.cursor = svg("g", { class: "cursor" });
    this.plot.setAttribute("viewBox", `0 0 ${this.width} ${HEIGHT}`);
    const entry = this.view.rate ? "success rate" : "return";
    const names = this.lines.map(({ label }) => label).join(", ");
    this.plot.setAttribute("aria-label", `${entry} over ${this.abscissa} on ${this.task}: ${names}`);
    this.plot.replaceChildren(
      ...this.axes(low - room, high + room, last, entry),
      ...this.lines.map((line) => this.line(line)),
      this.cursor,
    );
  }

  // The lowest and highest values that are drawn
  range() {
    const values = this.lines.flatMap(({ curve }) => [
      ...curve.mean.flatMap((mean, i) => (mean == null ? [] : [mean - curve.sem[i], mean + curve.sem[i]])),
      ...(this.view.seeds ? curve.seeds.flat().filter((value) => value != null) : []),
    ]);
    return [values.reduce((a, b) => Math.min(a, b)), values.reduce((a, b) => Math.max(a, b))];
  }

  axes(low, high, last, entry) {
    const [left, right, bottom] = [MARGIN.left, this.width - MARGIN.right, HEIGHT - MARGIN.bottom];
    const levels = ticks(low, high, 5).map((value) => [
      svg("line", { class: "grid", x1: left, x2: right, y1: this.y(value), y2: this.y(value) }),
      svg(
        "text",
        { x: left - 6, y: this.y(value) + 4, "text-anchor": "end" },
        this.view.rate ? percent(value) : short(value),
      ),
    ]);
    const times = ticks(0, last, Math.max(2, Math.min(6, this.width / 90))).map((step) =>
      svg("text", { x: this.x(step), y: bottom + 16, "text-anchor": "middle" }, short(step)),
    );
    return [
      ...levels.flat(),
      ...times,
      svg("line", { class: "axis", x1: left, x2: right, y1: bottom, y2: bottom }),
      svg(
        "text",
        { class: "name", x: (left + right) / 2, y: HEIGHT - 3, "text-anchor": "middle" },
        this.abscissa,
      ),
      svg(
        "text",
        { class: "name", transform: `translate(11 ${(MARGIN.top + bottom) / 2}) rotate(-90)`, "text-anchor": "middle" },
        entry,
      ),
    ];
  }

  line({ label, curve }) {
    const place = (values) => values.map((value, i) => [this.x(curve.steps[i]), this.y(value)]);
    const edge = (sign) =>
      place(curve.mean.map((mean, i) => (mean == null ? null : mean + sign * curve.sem[i]))).filter(
        ([, y]) => y != null,
      );
    const band = curve.sem.some((error) => error > 0) && path([...edge(1), ...edge(-1).reverse()]) + "Z";
    const several = curve.seeds.length > 1;
    const ends = place(curve.mean).filter(([, y]) => y != null);
    return coloured(
      svg(
        "g",
        { class: "line", "data-label": label },
        band ? svg("path", { class: "band", d: band }) : null,
        this.view.seeds && several
          ? curve.seeds.map((seed) => svg("path", { class: "seed", d: path(place(seed)) }))
          : null,
        svg("path", { class: "mean", d: path(place(curve.mean)), "stroke-dasharray": dashes(label) }),
        ends.length === 1 ? svg("circle", { cx: ends[0][0], cy: ends[0][1], r: 3 }) : null,
      ),
      label,
    );
  }

  nearest(event) {
    const x = event.clientX - this.plot.getBoundingClientRect().left;
    return this.steps.reduce(
      (best, step, i) => (Math.abs(this.x(step) - x) < Math.abs(this.x(this.steps[best]) - x) ? i : best),
      0,
    );
  }

  key(event) {
    const move = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!move) return;
    event.preventDefault();
    this.point(
      Math.max(0, Math.min(this.steps.length - 1, (this.index ?? (move > 0 ? -1 : this.steps.length)) + move)),
    );
  }

  // Show the numbers of all lines with an evaluation at this step, the best first
  point(index) {
    this.index = index;
    this.tip.replaceChildren();
    this.cursor?.replaceChildren();
    if (index == null || !this.cursor) return;
    if (Panel.pointed !== this) Panel.pointed?.point(null);
    Panel.pointed = this;
    const step = this.steps[index];
    const rows = this.lines
      .map((line) => ({ ...line, i: line.curve.steps.indexOf(step) }))
      .filter(({ curve, i }) => i >= 0 && curve.mean[i] != null)
      .sort((a, b) => b.curve.mean[b.i] - a.curve.mean[a.i]);
    this.cursor.append(
      svg("line", { x1: this.x(step), x2: this.x(step), y1: MARGIN.top, y2: HEIGHT - MARGIN.bottom }),
      ...rows.map(({ label, curve, i }) =>
        coloured(svg("circle", { cx: this.x(step), cy: this.y(curve.mean[i]), r: 3.5 }), label),
      ),
    );
    this.tip.append(
      html("b", {}, `step ${whole(step)}`),
      html(
        "table",
        {},
        rows.map(({ label, curve, i }) =>
          html(
            "tr",
            {},
            html("td", {}, swatch(label), " ", label),
            html("td", {}, withError(curve.mean[i], curve.sem[i], this.view.rate)),
            html("td", {}, plural(curve.count[i], "seed")),
          ),
        ),
      ),
    );
    const box = this.figure.getBoundingClientRect();
    const left =
      this.x(step) + 14 + this.tip.offsetWidth < box.width
        ? this.x(step) + 14
        : this.x(step) - this.tip.offsetWidth - 14;
    const middle = rows.reduce((sum, { curve, i }) => sum + this.y(curve.mean[i]), 0) / rows.length;
    this.tip.style.left = `${Math.max(4, Math.min(left, box.width - this.tip.offsetWidth - 4))}px`;
    this.tip.classList.toggle("low", middle < HEIGHT / 2);
  }
}
