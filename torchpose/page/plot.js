"use strict";
// Angles over time: a panel for each, left and right in one, with a band of two standard deviations to each side.

const MARGIN = { left: 30, right: 4, top: 3, bottom: 3 };
const AXIS = 13; // px for the numbers of the time axis

// Round numbers from low to high, about `most` of them.
function ticks(low, high, most) {
  const rough = (high - low) / Math.max(most, 1), power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= rough * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) found.push(k * step);
  return { step, found };
}

// Round times; from two minutes on in minutes, and in hours.
const ROUND = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 14400, 43200, 86400];
function timeTicks(low, high, most) {
  const step = ROUND.find((s) => s >= (high - low) / Math.max(most, 1));
  if (high - low < 4 || !step) return ticks(low, high, most);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9; k++) found.push(k * step);
  return { step, found };
}

const unitOf = (total) => (total < 120 ? "s" : total < 3600 ? "min:s" : "h:min:s");

// A time in the unit of a whole run that takes `total` s.
function clock(seconds, step, total) {
  const digits = step >= 1 ? 0 : Math.min(Math.ceil(-Math.log10(step) - 1e-9), 3);
  if (total < 120) return seconds.toFixed(digits);
  const whole = Math.floor(seconds / 60 + 1e-9), pad = (value) => String(value).padStart(2, "0");
  const rest = (seconds - 60 * whole).toFixed(digits).padStart(digits ? digits + 3 : 2, "0");
  return total < 3600 ? `${whole}:${rest}` : `${Math.floor(whole / 60)}:${pad(whole % 60)}:${rest}`;
}

// Makes a canvas as fine as the screen; returns its context, in CSS px, and its size.
function fresh(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const width = Math.max(canvas.clientWidth, 2), height = Math.max(canvas.clientHeight, 2);
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { context, width, height };
}

// The pattern of frames without a pose.
function hatch(context) {
  const tile = document.createElement("canvas");
  tile.width = tile.height = 6;
  const pen = tile.getContext("2d");
  pen.fillStyle = "#ebebeb";
  pen.fillRect(0, 0, 6, 6);
  pen.strokeStyle = "#bdbdbd";
  pen.beginPath();
  for (const shift of [-6, 0, 6]) {
    pen.moveTo(shift, 6);
    pen.lineTo(shift + 6, 0);
  }
  pen.stroke();
  return context.createPattern(tile, "repeat");
}

// Stretches [first, last] of equal values among the samples first to last.
function* stretches(values, first, last) {
  let start = first;
  for (let i = first + 1; i <= last + 1; i++) {
    if (i > last || values[i] !== values[start]) {
      yield [start, i - 1, values[start]];
      start = i;
    }
  }
}

class Plot {
  // lines: [{values, sd, colour}], degrees, NaN where there is none
  constructor(canvas, leastSpan) {
    this.canvas = canvas;
    this.leastSpan = leastSpan;
  }

  setLines(lines) {
    this.lines = lines;
    let low = Infinity, high = -Infinity;
    for (const { values, sd } of lines) {
      const spread = Float64Array.from(sd.filter((s, i) => s === s && values[i] === values[i])).sort();
      const margin = spread.length ? 2 * spread[spread.length >> 1] : 0;
      for (const value of values) {
        if (value - margin < low) low = value - margin;
        if (value + margin > high) high = value + margin;
      }
    }
    if (low > high) low = high = 0;
    const half = Math.max(this.leastSpan, 1.06 * (high - low)) / 2;
    this.low = (low + high) / 2 - half;
    this.high = (low + high) / 2 + half;
  }

  // axes: {time, edges (time's borders between samples), start, end, total, status, styles, numbers}
  draw(axes) {
    const { context, width, height } = fresh(this.canvas);
    const box = { x: MARGIN.left, y: MARGIN.top, w: width - MARGIN.left - MARGIN.right };
    box.h = height - MARGIN.top - (axes.numbers ? AXIS : MARGIN.bottom);
    const x = (t) => box.x + (box.w * (t - axes.start)) / (axes.end - axes.start);
    const y = (v) => box.y + (box.h * (this.high - v)) / (this.high - this.low);
    const { time, edges } = axes;
    let first = 0, last = time.length - 1;
    while (first < last && edges[first + 1] < axes.start) first++;
    while (last > first && edges[last] > axes.end) last--;

    context.save();
    context.beginPath();
    context.rect(box.x, box.y, box.w, box.h);
    context.clip();
    const pattern = hatch(context);
    for (const [from, to, status] of stretches(axes.status, first, last)) {
      const style = axes.styles[status];
      if (!style.posed) context.fillStyle = pattern;
      else if (style.tint) context.fillStyle = style.tint;
      else continue;
      context.fillRect(x(edges[from]), box.y, Math.max(x(edges[to + 1]) - x(edges[from]), 1), box.h);
    }
    this.drawGrid(context, axes, box, x, y);
    for (const line of this.lines) this.drawLine(context, line, time, first, last, x, y, box.w);
    context.restore();
    this.drawNumbers(context, axes, box, x, y);
  }

  drawGrid(context, axes, box, x, y) {
    this.across = timeTicks(axes.start, axes.end, box.w / 45);
    this.up = ticks(this.low, this.high, box.h / 22);
    context.lineWidth = 1;
    for (const [values, upright] of [[this.across.found, true], [this.up.found, false]]) {
      for (const value of values) {
        const zero = !upright && Math.abs(value) < 1e-9;
        context.strokeStyle = zero ? "#9aa4ae" : "rgba(120,130,140,.16)";
        const at = Math.round(upright ? x(value) : y(value)) + 0.5;
        context.beginPath();
        if (upright) { context.moveTo(at, box.y); context.lineTo(at, box.y + box.h); }
        else { context.moveTo(box.x, at); context.lineTo(box.x + box.w, at); }
        context.stroke();
      }
    }
  }

  drawNumbers(context, axes, box, x, y) {
    context.font = "10px system-ui, sans-serif";
    context.fillStyle = "#57606a";
    context.textBaseline = "middle";
    context.textAlign = "right";
    for (const value of this.up.found) {
      const at = y(value);
      if (at > box.y + 3 && at < box.y + box.h - 2) context.fillText(String(+value.toFixed(3)).replace("-", "−"), box.x - 4, at);
    }
    context.strokeStyle = "#8b949e";
    context.beginPath();
    context.moveTo(box.x - 0.5, box.y);
    context.lineTo(box.x - 0.5, box.y + box.h + 0.5);
    context.lineTo(box.x + box.w, box.y + box.h + 0.5);
    context.stroke();
    if (!axes.numbers) return;
    context.textBaseline = "top";
    context.textAlign = "center";
    for (const value of this.across.found) {
      const at = x(value);
      if (at < box.x + box.w - 40) context.fillText(clock(value, this.across.step, axes.total), Math.max(at, box.x + 3), box.y + box.h + 3);
    }
    context.textAlign = "right";
    context.fillText(unitOf(axes.total), box.x + box.w, box.y + box.h + 3);
  }

  // Where there are more samples than pixels, each column of pixels shows the least and the greatest of its own.
  drawLine(context, { values, sd, colour }, time, first, last, x, y, width) {
    const thick = last - first > 2 * width;
    const rows = [];
    let column = null, before = NaN;
    for (let i = Math.max(first - 1, 0); i <= Math.min(last + 1, time.length - 1); i++) {
      const value = values[i], reach = sd[i] === sd[i] ? 2 * sd[i] : 0, at = x(time[i]);
      // A step of more than half a turn goes round the circle: nothing is drawn across the panel for it.
      if (value !== value || Math.abs(value - before) > 180) { rows.push(null); column = null; }
      before = value;
      if (value !== value) continue;
      const row = { x: thick ? Math.floor(at) + 0.5 : at, low: value, high: value, bottom: value - reach, top: value + reach };
      if (thick && column && column.x === row.x) {
        column.low = Math.min(column.low, row.low); column.high = Math.max(column.high, row.high);
        column.bottom = Math.min(column.bottom, row.bottom); column.top = Math.max(column.top, row.top);
      } else {
        rows.push(row);
        column = row;
      }
    }
    rows.push(null);
    let run = [];
    for (const row of rows) {
      if (row) { run.push(row); continue; }
      if (run.length) this.drawRun(context, run, colour, x, y, thick);
      run = [];
    }
  }

  drawRun(context, run, colour, x, y, thick) {
    context.fillStyle = `rgba(${colour.join()},.17)`;
    context.beginPath();
    for (const row of run) context.lineTo(row.x, y(row.top));
    for (const row of run.slice().reverse()) context.lineTo(row.x, y(row.bottom));
    context.fill();
    context.strokeStyle = context.fillStyle = `rgba(${colour.join()},${thick ? 0.6 : 1})`; // many lie over one another
    context.lineWidth = thick ? 1 : 1.5;
    context.lineJoin = "round";
    context.beginPath();
    for (const row of run) {
      context.lineTo(row.x, y(row.low));
      if (thick && row.high > row.low) context.lineTo(row.x, y(row.high));
    }
    context.stroke();
    if (run.length === 1) {
      context.beginPath();
      context.arc(run[0].x, y(run[0].low), 1.6, 0, 2 * Math.PI);
      context.fill();
    }
  }
}
