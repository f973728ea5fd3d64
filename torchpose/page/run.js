"use strict";
// The run as the page holds it: its numbers unpacked, and how they are looked up.

const element = (id) => document.getElementById(id);
const data = JSON.parse(element("data").textContent);
const activities = JSON.parse(element("activities").textContent);

// Text goes into the page as text alone: names and warnings may hold anything.
function make(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== null) made.setAttribute(name, value);
  }
  made.append(...children);
  return made;
}

function unpack(text, type) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return new type(bytes.buffer);
}

const LEFT = [213, 94, 0], RIGHT = [0, 114, 178], MIDDLE = [60, 60, 60];
const SIDES = { left: LEFT, right: RIGHT, "": MIDDLE };
const css = (colour) => `rgb(${colour.join()})`;
const position = unpack(data.position, Int32Array), frame = unpack(data.frame, Int32Array);
const time = unpack(data.time, Float64Array), shown = unpack(data.shown, Int32Array);
const count = position.length, parts = data.parts.length, numJoints = data.joint_names.length;
const styles = data.statuses.map(([name, colour, posed]) => ({
  name, colour, posed, tint: !posed || name === "tracked" ? null : `rgba(${colour.join()},.2)`,
}));
const people = data.people.map((packed) => {
  const one = { radii: packed.radii };
  for (const name of ["angles", "sd", "joints", "centres", "axes", "points"]) one[name] = unpack(packed[name], Int16Array);
  one.status = unpack(packed.status, Uint8Array);
  one.distance = unpack(packed.distance, Float32Array);
  one.labels = unpack(packed.labels, Int8Array);
  one.starts = unpack(packed.starts, Int32Array);
  return one;
});
const numAngles = count ? people[0].angles.length / count : 0;

// The borders between samples in time, half way between neighbours.
const edges = new Float64Array(count + 1);
for (let i = 1; i < count; i++) edges[i] = (time[i - 1] + time[i]) / 2;
if (count) {
  const half = count > 1 ? [(time[1] - time[0]) / 2, (time[count - 1] - time[count - 2]) / 2] : [0.5, 0.5];
  edges[0] = time[0] - half[0];
  edges[count] = time[count - 1] + half[1];
}

const summary = data.summary;

// ---- looking things up ----

function sampleAt(t) {
  let low = 0, high = count - 1;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (edges[middle + 1] <= t) low = middle + 1; else high = middle;
  }
  return low;
}

function nearestShown(sample) {
  let best = -1;
  for (let i = 0; i < shown.length; i++) {
    if (best < 0 || Math.abs(shown[i] - sample) < Math.abs(shown[best] - sample)) best = i;
  }
  return best;
}

function column(packed, index) {
  const values = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    const value = packed[i * numAngles + index];
    values[i] = value === data.missing ? NaN : value / 100;
  }
  return values;
}

function place(packed, index) {
  const [x, y, z] = [0, 1, 2].map((axis) => packed[3 * index + axis]);
  return x === data.missing ? null : [x / 1000, y / 1000, z / 1000];
}

function bodyAt(one, sample) {
  const ellipsoids = [], joints = [];
  for (let joint = 0; joint < numJoints; joint++) joints.push(place(one.joints, sample * numJoints + joint));
  for (let part = 0; part < parts; part++) {
    const centre = place(one.centres, sample * parts + part);
    if (!centre) continue;
    const at = 6 * (sample * parts + part);
    const [a, b] = [0, 3].map((start) => {
      const axis = [0, 1, 2].map((i) => one.axes[at + start + i]), length = Math.hypot(...axis) || 1;
      return axis.map((value) => value / length);
    });
    const c = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    ellipsoids.push({ centre, axes: [a, b, c], radii: one.radii[part] });
  }
  return { ellipsoids, joints, name: people.length > 1 ? String(people.indexOf(one) + 1) : "" };
}

function cloudAt(one, image) {
  const [start, end] = [one.starts[image], one.starts[image + 1]];
  const points = Float32Array.from(one.points.subarray(3 * start, 3 * end), (mm) => mm / 1000);
  return { points, labels: one.labels.subarray(start, end) };
}

const nameOf = (index) => (people.length > 1 ? `person ${index + 1}` : "the person");

// ---- in words ----

const number = (value, digits = 1) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const inMillimetres = (metres) => (metres === null ? "–" : number(1000 * metres));
const inWords = (counts) => Object.entries(counts || {}).map(([name, n]) => `${n} ${name}`).join(", ");
const countsOf = (index) => inWords(index === 0 ? summary.status : (summary.others || [])[index - 1]);

function table(rows) {
  return make("table", {}, ...rows.map(([name, value]) => make("tr", {}, make("th", { scope: "row" }, name), make("td", {}, String(value)))));
}

function flat(value, prefix = "") {
  if (value === null || typeof value !== "object") return [[prefix, value === null ? "null" : value]];
  if (Array.isArray(value)) return [[prefix, value.join(", ")]];
  return Object.entries(value).flatMap(([name, item]) => flat(item, prefix ? `${prefix}.${name}` : name));
}
