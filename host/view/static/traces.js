// Traces over time on a canvas: lanes one above the other, each with its own scale, lines, a band and marked windows.

const KEEP_S = 30, SHOW_S = 20, LEFT = 46, RIGHT = 10, BOTTOM = 20, GAP = 23;

function niceStep(span, count) {
  const raw = span / count, power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map(m => m * power).find(step => step >= raw);
}

const digitsOf = step => Math.max(0, -Math.floor(Math.log10(step) + 1e-9));

export class Traces {
  // lanes: [{label, unit, scale, least (smallest span shown), limit?, lines: [{name, label, color, dash?, band?}]}]
  constructor(canvas, lanes) {
    Object.assign(this, {canvas, lanes, windows: [], origin: null, now: 0});
    this.clear();
    this.dirty = true;
    new ResizeObserver(() => { this.dirty = true; }).observe(canvas);
  }

  clear() {
    this.times = {};
    this.values = {};
    for (const lane of this.lanes) for (const line of lane.lines) { this.times[line.name] = []; this.values[line.name] = []; }
  }

  add(name, t, value, spread = null) {
    const times = this.times[name];
    if (times.length && t <= times[times.length - 1]) return;
    times.push(t);
    this.values[name].push([value, spread]);
    if (times.length > 4000 || t - times[0] > KEEP_S + 5) {
      const first = Math.max(times.findIndex(old => t - old <= KEEP_S), times.length - 4000);
      times.splice(0, first);
      this.values[name].splice(0, first);
    }
  }

  draw(now) {
    this.now = now;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width) return;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const style = getComputedStyle(this.canvas);
    const color = name => style.getPropertyValue(`--${name}`).trim();
    // Drawn by the processor: where the graphics card is one in software too, lines on it cost a second a frame.
    const g = this.canvas.getContext("2d", {willReadFrequently: true});
    g.setTransform(ratio, 0, 0, ratio, 0, 0);
    g.clearRect(0, 0, width, height);
    g.font = "12px system-ui, sans-serif";
    const laneHeight = (height - BOTTOM) / this.lanes.length;
    const area = {left: LEFT, right: width - RIGHT, from: now - SHOW_S, to: now};
    const x = t => area.left + (t - area.from) / SHOW_S * (area.right - area.left);
    this.lanes.forEach((lane, index) => {
      const top = index * laneHeight + GAP, bottom = (index + 1) * laneHeight - 4;
      this.#lane(g, lane, {...area, top, bottom, x, color});
    });
    this.#timeAxis(g, {...area, x, color, bottom: height - BOTTOM + 4, width});
  }

  #range(lane, from) {
    let low = Infinity, high = -Infinity;
    for (const line of lane.lines) {
      const times = this.times[line.name], values = this.values[line.name];
      for (let i = times.length - 1; i >= 0 && times[i] >= from; i--) {
        const [value] = values[i];
        if (value === null || times[i] > this.now) continue;
        low = Math.min(low, value);
        high = Math.max(high, value);
      }
    }
    if (low > high) [low, high] = [0, 0];
    const span = Math.max(high - low, lane.least), middle = (high + low) / 2;
    return [middle - span / 2, middle + span / 2];
  }

  // The range widened to whole steps, so that both ends of the axis bear a number: [low, high, step].
  #axis(lane, a) {
    const [low, high] = this.#range(lane, a.from);
    const step = niceStep((high - low) * lane.scale, Math.max(2, Math.floor((a.bottom - a.top) / 34))) / lane.scale;
    return [Math.floor(low / step + 1e-6) * step, Math.ceil(high / step - 1e-6) * step, step * lane.scale];
  }

  #lane(g, lane, a) {
    const [low, high, step] = this.#axis(lane, a);
    const y = value => a.bottom - (value - low) / (high - low) * (a.bottom - a.top);
    g.save();
    g.beginPath();
    g.rect(a.left, a.top, a.right - a.left, a.bottom - a.top);
    g.clip();
    g.globalAlpha = 0.16;
    g.fillStyle = a.color("warn");
    for (const window of this.windows) g.fillRect(a.x(window.from), a.top, Math.max(a.x(window.to) - a.x(window.from), 1), a.bottom - a.top);
    g.restore();
    this.#grid(g, lane, a, [low, high, step], y);
    g.save();
    g.beginPath();
    g.rect(a.left, a.top - 1, a.right - a.left, a.bottom - a.top + 2);
    g.clip();
    if (lane.limit && lane.limit < high) {
      g.strokeStyle = a.color("limit");
      g.setLineDash([2, 3]);
      g.beginPath();
      g.moveTo(a.left, y(lane.limit));
      g.lineTo(a.right, y(lane.limit));
      g.stroke();
    }
    for (const line of lane.lines) this.#line(g, line, a, y);
    g.restore();
    this.#legend(g, lane, a);
  }

  #grid(g, lane, a, [low, high, step], y) {
    g.strokeStyle = a.color("grid");
    g.fillStyle = a.color("muted");
    g.textAlign = "right";
    g.textBaseline = "middle";
    g.lineWidth = 1;
    g.setLineDash([]);
    const first = Math.round(low * lane.scale / step), last = Math.round(high * lane.scale / step);
    for (let number = first; number <= last; number++) {
      const tick = number * step;
      const at = Math.round(y(tick / lane.scale)) + 0.5;
      g.beginPath();
      g.moveTo(a.left, at);
      g.lineTo(a.right, at);
      g.stroke();
      g.fillText((Math.abs(tick) < step / 2 ? 0 : tick).toFixed(digitsOf(step)), a.left - 6, at);
    }
  }

  #line(g, line, a, y) {
    const times = this.times[line.name], values = this.values[line.name];
    let first = times.length;
    while (first > 0 && times[first - 1] >= a.from) first--;
    first = Math.max(first - 1, 0);
    if (line.band) {
      g.fillStyle = a.color(line.color);
      g.globalAlpha = 0.18;
      for (let i = first; i + 1 < times.length; i++) {
        const [v, s] = values[i], [w, r] = values[i + 1];
        if (v === null || w === null || times[i + 1] - times[i] > 0.3) continue;
        g.beginPath();
        g.moveTo(a.x(times[i]), y(v - s));
        g.lineTo(a.x(times[i]), y(v + s));
        g.lineTo(a.x(times[i + 1]), y(w + r));
        g.lineTo(a.x(times[i + 1]), y(w - r));
        g.fill();
      }
      g.globalAlpha = 1;
    }
    g.strokeStyle = a.color(line.color);
    g.lineWidth = line.dash ? 1.5 : 1.6;
    g.setLineDash(line.dash || []);
    g.beginPath();
    let down = false, last = 0;
    for (let i = first; i < times.length; i++) {
      const [value] = values[i];
      if (value === null || times[i] - last > 0.5) down = false;
      if (value !== null) {
        if (down) g.lineTo(a.x(times[i]), y(value)); else g.moveTo(a.x(times[i]), y(value));
        down = true;
      }
      last = times[i];
    }
    g.stroke();
    g.setLineDash([]);
  }

  #legend(g, lane, a) {
    g.textAlign = "left";
    g.textBaseline = "alphabetic";
    g.fillStyle = a.color("muted");
    let at = 2;
    const write = text => { g.fillText(text, at, a.top - 7); at += g.measureText(text).width + 10; };
    write(`${lane.label} ${lane.unit}`.trim());
    for (const line of lane.lines) {
      const values = this.values[line.name], newest = values.length ? values[values.length - 1][0] : null;
      if (!line.label) continue;
      g.fillStyle = a.color(line.color);
      write(`${line.label} ${newest === null ? "–" : (newest * lane.scale).toFixed(lane.digits)}`);
    }
  }

  #timeAxis(g, a) {
    g.fillStyle = a.color("muted");
    g.textBaseline = "top";
    const step = a.right - a.left < 260 ? 10 : 5;
    if (this.origin === null) {
      for (let back = 0; back <= SHOW_S; back += step) {
        g.textAlign = back === 0 ? "right" : "center";
        g.fillText(back === 0 ? "now" : `−${back} s`, Math.min(a.x(a.to - back), a.right), a.bottom);
      }
      return;
    }
    g.textAlign = "center";
    for (let at = Math.ceil((a.from - this.origin) / step) * step; at <= a.to - this.origin; at += step) {
      const place = a.x(at + this.origin);
      if (at >= 0 && place > a.left + 8 && place < a.right - 12) g.fillText(`${at} s`, place, a.bottom);
    }
  }
}
