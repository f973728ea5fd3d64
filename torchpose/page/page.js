"use strict";
// The page: one cursor, a sample of the run, that pictures, 3-D view, plots and time line share.

(() => {
  // A long run begins with a stretch in which single movements can be seen.
  const LONG = 60, STRETCH = 20; // s
  const beginning = edges[count] - edges[0] > LONG ? edges[0] + STRETCH : edges[count];
  let cursor = 0, person = 0, span = [edges[0], beginning], playing = null;

  // ---- the 3-D view ----

  const boneColours = data.bones.map(([, end]) => {
    const side = data.joint_names[end].split("_").pop();
    return css(side === "left" ? LEFT : side === "right" ? RIGHT : [255, 255, 255]);
  });
  const scene = new Scene(element("scene"), data.part_colours, data.bones, boneColours, data.floor);
  const START = { yaw: -0.55, pitch: 0.16 };
  const looks = { camera: { yaw: 0, pitch: Math.asin(scene.level[1][2]) }, side: { yaw: -Math.PI / 2, pitch: 0.06 }, above: { yaw: 0, pitch: 1.5 }, free: START };

  // All that is ever seen of anybody, or what the person who is followed reaches around the hips.
  function frameScene() {
    const all = [], hips = following && place(people[person].joints, cursor * numJoints);
    for (const one of following ? [people[person]] : people) {
      for (let i = 0; i < one.joints.length / 3; i++) {
        const joint = place(one.joints, i), pelvis = place(one.joints, i - (i % numJoints));
        if (!joint || !pelvis) continue;
        all.push(...(following && hips ? joint.map((value, axis) => value - pelvis[axis] + hips[axis]) : joint));
      }
    }
    scene.frame(all);
    followed = hips || null;
  }

  // The view goes along with the chosen person: what matters is the body, not the way through the room.
  let following = people.length === 1, followed = null;
  function follow() {
    if (!count || !following) return;
    const hips = place(people[person].joints, cursor * numJoints);
    if (!hips) return;
    if (followed) {
      const way = hips.map((value, axis) => value - followed[axis]), up = dot(way, scene.level[1]);
      scene.target = scene.target.map((value, axis) => value + way[axis] - up * scene.level[1][axis]);
    }
    followed = hips;
  }

  let waiting = false;
  function drawScene() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => {
      waiting = false;
      const image = nearestShown(cursor), exact = image >= 0 && shown[image] === cursor;
      follow();
      scene.draw(
        count ? people.map((one) => bodyAt(one, cursor)) : [],
        exact ? people.map((one) => cloudAt(one, image)) : [],
      );
    });
  }

  function setUpScene() {
    const canvas = element("scene");
    frameScene();
    let last = null;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      last = [event.clientX, event.clientY];
    });
    canvas.addEventListener("pointerup", () => { last = null; });
    canvas.addEventListener("pointercancel", () => { last = null; });
    canvas.addEventListener("pointermove", (event) => {
      if (!last) return;
      const dx = event.clientX - last[0], dy = event.clientY - last[1];
      last = [event.clientX, event.clientY];
      if (event.shiftKey || event.buttons & 2) move(dx, dy); else turn(-0.009 * dx, 0.009 * dy);
    });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoomScene(Math.exp(0.0015 * Math.max(Math.min(event.deltaY, 200), -200)));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => lookFrom("free", true));
    for (const name of Object.keys(looks)) {
      const title = name === "free" ? "Turned a little (double click)" : `Seen from ${name === "above" ? name : `the ${name}`}`;
      element("looks").append(make("button", { type: "button", title, onclick: () => lookFrom(name, true) }, name === "free" ? "3-D" : name));
    }
    for (const layer of Object.keys(scene.layers)) {
      const button = make("button", { type: "button", "aria-pressed": "true", title: `Show or hide the ${layer}` }, layer);
      button.addEventListener("click", () => {
        scene.layers[layer] = !scene.layers[layer];
        button.setAttribute("aria-pressed", String(scene.layers[layer]));
        drawScene();
      });
      element("layers").append(button);
    }
    const button = make("button", { type: "button", "aria-pressed": String(following), title: "Go along with the person, or show the whole way" }, "follow");
    button.addEventListener("click", () => {
      following = !following;
      button.setAttribute("aria-pressed", String(following));
      frameScene();
      drawScene();
    });
    element("layers").append(button);
  }

  function lookFrom(name, again) {
    Object.assign(scene.look, looks[name]);
    if (again) frameScene();
    drawScene();
  }

  function turn(yaw, pitch) {
    scene.look.yaw += yaw;
    scene.look.pitch = Math.max(-0.05, Math.min(1.55, scene.look.pitch + pitch)); // never below the floor
    drawScene();
  }

  function move(dx, dy) {
    const [right, down] = scene.axes(), scale = scene.look.distance / (FIELD * Math.min(scene.canvas.clientWidth, scene.canvas.clientHeight));
    scene.target = scene.target.map((value, i) => value - scale * (dx * right[i] + dy * down[i]));
    drawScene();
  }

  function zoomScene(factor) {
    scene.look.distance = Math.max(0.4, Math.min(40, scene.look.distance * factor));
    drawScene();
  }

  // ---- the plots ----

  const panels = [];
  function setUpPlots() {
    for (const panel of data.panels) {
      const [name, all] = panel.title.split(": "), meaning = (all || "").replace(/, [^+]*−$/, ""); // "flexion +" says it
      const values = make("span", { class: "values", "aria-hidden": "true" });
      const canvas = make("canvas", { role: "img", "aria-label": `${panel.title}, degrees over time` });
      const line = make("div", { class: "cursor" });
      const heading = make("h2", { title: panel.title }, make("span", { class: "name" }, name, make("span", {}, meaning && ` ${meaning}`)), values);
      element("plots").append(make("div", { class: "panel" }, heading, make("div", { class: "plot" }, canvas, line)));
      const plot = new Plot(canvas, data.least_span);
      panels.push({ plot, line, values, canvas, lines: panel.lines });
      seekable(canvas, (x) => span[0] + ((x - MARGIN.left) / (canvas.clientWidth - MARGIN.left - MARGIN.right)) * (span[1] - span[0]));
      canvas.addEventListener("wheel", (event) => {
        if (!event.ctrlKey && !event.metaKey && !event.shiftKey) return;
        event.preventDefault();
        zoomTime(Math.exp(0.002 * Math.max(Math.min(event.deltaY || event.deltaX, 200), -200)));
      }, { passive: false });
    }
    const key = make("div", { class: "key" });
    const entry = (style, text) => key.append(make("div", {}, make("span", { class: "swatch", style }), text));
    entry(`height:3px;background:${css(LEFT)}`, "left");
    entry("background:rgba(60,60,60,.18)", "± two standard deviations");
    entry(`height:3px;background:${css(RIGHT)}`, "right");
    entry("background:repeating-linear-gradient(135deg,#ebebeb 0 3px,#bdbdbd 3px 4px)", "no pose");
    entry(`height:3px;background:${css(MIDDLE)}`, "trunk, neck");
    entry("background:linear-gradient(90deg,rgba(240,228,66,.3) 50%,rgba(86,180,233,.3) 50%)", "status, as below");
    key.append(make("div", { class: "wide" }, `Degrees. Left and right are the person's. What is less certain than ± ${Math.round(2 * data.worst_sd)}° is left out.`));
    element("plots").append(key);
  }

  function seekable(canvas, timeAt) {
    let down = false;
    const seek = (event) => {
      const box = canvas.getBoundingClientRect();
      select(sampleAt(timeAt(event.clientX - box.left)));
    };
    canvas.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      down = true;
      canvas.setPointerCapture(event.pointerId);
      pause();
      seek(event);
    });
    canvas.addEventListener("pointermove", (event) => { if (down) seek(event); });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { down = false; });
  }

  function choosePerson(chosen) {
    person = chosen;
    [...element("who").children].forEach((button, i) => button.setAttribute("aria-pressed", String(i === person)));
    for (const panel of panels) {
      panel.series = panel.lines.map(([side, index]) => {
        const values = count ? column(people[person].angles, index) : new Float32Array(0);
        const sd = count ? column(people[person].sd, index) : new Float32Array(0);
        const sure = values.map((value, i) => (sd[i] > data.worst_sd ? NaN : value)); // an unknown sd is not a large one
        return { side, values: sure, sd, colour: SIDES[side] };
      });
      panel.plot.setLines(panel.series);
    }
    if (following) frameScene();
    tellFacts();
    drawPlots();
  }

  function drawPlots() {
    if (!count) return;
    const length = span[1] - span[0], whole = edges[count] - edges[0];
    element("shown").textContent = length < whole - 1e-6 ? `${number(length, length < 10 ? 1 : 0)} of ${number(whole, 0)} s` : "";
    const across = new Set(panels.map((panel) => panel.canvas.getBoundingClientRect().left)).size;
    panels.forEach((panel, i) => panel.plot.draw({
      time, edges, start: span[0], end: span[1], total: edges[count], status: people[person].status, styles, numbers: i + across >= panels.length,
    }));
    update();
  }

  // ---- the time line ----

  const STATUS_HEIGHT = 13, ACTIVITY_HEIGHT = 17, GAP = 2, RULER = 14;
  const OKABE = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#332288", "#AA4499", "#44AA99", "#999933", "#661100"];
  const names = [...new Set(activities.flat().map((entry) => entry.activity))].filter((name) => !data.quiet.includes(name)).sort();
  const [PAUSE, OTHER, UNSEEN] = data.quiet;

  function activityStyle(name, context) {
    if (name === UNSEEN) return [hatch(context), "#1b1f24"];
    if (name === PAUSE) return ["#d5d9de", "#1b1f24"];
    if (name === OTHER) return ["#8b949e", "#000"];
    const colour = OKABE[names.indexOf(name) % OKABE.length];
    const [r, g, b] = [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
    return [colour, 0.299 * r + 0.587 * g + 0.114 * b > 140 ? "#000" : "#fff"];
  }

  const tracks = [];
  people.forEach((one, index) => {
    const who = people.length > 1 ? ` ${index + 1}` : "";
    tracks.push({ title: `status${who}`, height: STATUS_HEIGHT, index });
    if (activities[index] && activities[index].length) tracks.push({ title: `activity${who}`, height: ACTIVITY_HEIGHT, index, entries: activities[index] });
  });

  function setUpTime() {
    const line = element("line"), slider = element("time");
    let total = RULER;
    for (const track of tracks) {
      element("rows").append(make("div", { style: `height:${track.height + GAP}px;line-height:${track.height}px` }, track.title));
      total += track.height + GAP;
    }
    line.style.height = `${total}px`;
    slider.setAttribute("aria-valuemax", String(Math.max(count - 1, 0)));
    seekable(line, (x) => edges[0] + (x / line.clientWidth) * (edges[count] - edges[0]));
    const used = new Set(people.flatMap((one) => [...new Set(one.status)]));
    styles.forEach((style, i) => {
      if (used.has(i)) element("legend").append(make("span", {}, make("span", { class: "swatch", style: `background:${css(style.colour)}` }), style.name));
    });
  }

  function drawTime() {
    if (!count) return;
    const { context, width, height } = fresh(element("line"));
    const x = (t) => (width * (t - edges[0])) / (edges[count] - edges[0]);
    context.font = "11px system-ui, sans-serif";
    context.textBaseline = "middle";
    let top = 0;
    for (const track of tracks) {
      if (!track.entries) {
        for (const [first, last, status] of stretches(people[track.index].status, 0, count - 1)) {
          context.fillStyle = css(styles[status].colour);
          context.fillRect(x(edges[first]), top, Math.max(x(edges[last + 1]) - x(edges[first]), 1), track.height);
        }
      } else {
        for (const entry of track.entries) {
          const [fill, ink] = activityStyle(entry.activity, context);
          const left = x(entry.start_s), wide = Math.max(x(entry.end_s) - left, 1);
          context.fillStyle = fill;
          context.fillRect(left, top, Math.max(wide - 1, 1), track.height);
          const label = entry.activity.replaceAll("_", " ");
          context.fillStyle = ink;
          context.textAlign = "center";
          if (context.measureText(label).width < wide - 6) context.fillText(label, left + wide / 2, top + track.height / 2 + 0.5);
        }
      }
      top += track.height + GAP;
    }
    const marks = timeTicks(edges[0], edges[count], width / 90), unit = edges[count] < 120 ? " s" : "";
    context.font = "10px system-ui, sans-serif";
    context.fillStyle = "#57606a";
    context.textBaseline = "alphabetic";
    for (const t of marks.found) {
      context.fillRect(Math.round(x(t)), top - 1, 1, 3);
      context.textAlign = x(t) < 12 ? "left" : x(t) > width - 12 ? "right" : "center";
      context.fillText(clock(t, marks.step, edges[count]) + unit, x(t), height - 2);
    }
    if (span[0] > edges[0] || span[1] < edges[count]) {
      context.fillStyle = "rgba(255,255,255,.6)";
      context.fillRect(0, 0, x(span[0]), top);
      context.fillRect(x(span[1]), 0, width, top);
      context.strokeStyle = "#1b1f24";
      context.strokeRect(x(span[0]) + 0.5, 0.5, Math.max(x(span[1]) - x(span[0]) - 1, 1), top - 1.5);
    }
  }

  function zoomTime(factor) {
    if (!count) return;
    const whole = edges[count] - edges[0], least = Math.min(whole, 8 * (whole / count));
    const length = Math.max(least, Math.min(whole, (span[1] - span[0]) * factor));
    const share = Math.min(Math.max((time[cursor] - span[0]) / (span[1] - span[0]), 0), 1); // the cursor stays where it is
    const start = Math.max(edges[0], Math.min(edges[count] - length, time[cursor] - share * length));
    span = [start, start + length];
    drawPlots();
    drawTime();
  }

  // ---- the cursor ----

  const pictures = new Map(); // decoded pictures, the last few
  function picture(index) {
    if (!pictures.has(index)) {
      const image = new Image();
      image.src = `data:image/jpeg;base64,${data.images[index]}`;
      pictures.set(index, image);
      if (pictures.size > 40) pictures.delete(pictures.keys().next().value);
    }
    return pictures.get(index);
  }

  const whole = (value) => String(Math.round(value)).replace("-", "−");
  const degrees = (value) => (value === value ? `${whole(value)}°` : "–");

  let image = null;
  function update() {
    if (!count) return;
    const who = people[person], status = styles[who.status[cursor]].name;
    const doing = (activities[person] || []).find((entry) => entry.start_s <= time[cursor] && time[cursor] < entry.end_s);
    const distance = who.distance[cursor];
    const words = [`frame ${frame[cursor]}`, `${time[cursor].toFixed(2)} s`, status];
    if (distance === distance) words.push(`${(1000 * distance).toFixed(0)} mm off the model`);
    if (doing) words.push(doing.activity.replaceAll("_", " "));
    element("now").textContent = words.join(" · ");
    element("time").setAttribute("aria-valuenow", String(cursor));
    element("time").setAttribute("aria-valuetext", words.join(", "));

    const near = nearestShown(cursor);
    if (near >= 0) {
      if (near !== image) {
        image = near;
        element("image").src = picture(near).src;
        if (near + 1 < shown.length) picture(near + 1);
      }
      const exact = shown[near] === cursor;
      element("image").alt = `The camera's picture of frame ${frame[shown[near]]} with the fitted body drawn over it`;
      element("image-caption").textContent = `Frame ${frame[shown[near]]}` + (exact ? "" : `, the nearest of ${shown.length} with a picture`) + " · outlines and points by part, skeleton left orange, right blue";
      const posed = styles[who.status[cursor]].posed;
      const hint = exact ? "drag turns, wheel zooms, shift-drag moves" : "points only with a picture's own frame";
      element("scene-caption").textContent = posed ? `Grid 0.5 m, ${data.floor_seen ? "on the floor" : "laid under the feet"} · ${hint}` : `No pose of ${nameOf(person)} in this frame`;
    }
    for (const panel of panels) {
      const inside = time[cursor] >= span[0] && time[cursor] <= span[1];
      const wide = panel.canvas.clientWidth - MARGIN.left - MARGIN.right;
      panel.line.hidden = !inside;
      panel.line.style.left = `${MARGIN.left + (wide * (time[cursor] - span[0])) / (span[1] - span[0]) - 0.75}px`;
      panel.values.replaceChildren(...panel.series.map(({ values, sd, colour }) => {
        const known = values[cursor] === values[cursor] && sd[cursor] === sd[cursor];
        return make("span", { style: `color:${css(colour)}` }, degrees(values[cursor]), make("small", {}, known ? ` ±${whole(2 * sd[cursor])}` : ""));
      }));
    }
    const mark = element("track").querySelector(".cursor");
    mark.style.left = `${(100 * (time[cursor] - edges[0])) / (edges[count] - edges[0])}%`;
    drawScene();
  }

  function select(sample) {
    const next = Math.max(0, Math.min(count - 1, sample));
    if (next === cursor || !count) return;
    cursor = next;
    if (time[cursor] < span[0] || time[cursor] > span[1]) {
      const length = span[1] - span[0], start = Math.max(edges[0], Math.min(edges[count] - length, time[cursor] - length / 2));
      span = [start, start + length];
      drawPlots();
      drawTime();
    } else update();
  }

  // ---- playing ----

  function play() {
    if (count < 2) return;
    if (cursor === count - 1) select(0);
    playing = { since: performance.now(), from: time[cursor] };
    element("play").setAttribute("aria-label", "Pause");
    requestAnimationFrame(step);
  }

  function pause() {
    playing = null;
    element("play").setAttribute("aria-label", "Play");
  }

  function step(now) {
    if (!playing) return;
    const t = playing.from + ((now - playing.since) / 1000) * Number(element("speed").value);
    select(sampleAt(t));
    if (t >= time[count - 1]) pause(); else requestAnimationFrame(step);
  }

  const toggle = () => (playing ? pause() : play());

  function setUpControl() {
    element("play").addEventListener("click", toggle);
    for (const speed of [0.1, 0.25, 0.5, 1, 2, 5, 20]) {
      element("speed").append(make("option", { value: speed, ...(speed === 1 ? { selected: "" } : {}) }, `${speed} ×`));
    }
    element("speed").addEventListener("change", () => { if (playing) playing = { since: performance.now(), from: time[cursor] }; });
    element("zoom").append(make("span", { class: "quiet", id: "shown" }));
    for (const [text, title, action] of [["−", "Show more time (-)", () => zoomTime(2)], ["+", "Show less time (+, or ctrl-wheel on a plot)", () => zoomTime(0.5)], ["all", "Show the whole run (0)", () => zoomTime(Infinity)]]) {
      element("zoom").append(make("button", { type: "button", title, "aria-label": title, onclick: action }, text));
    }
    const keys = {
      ArrowLeft: (n) => select(cursor - n), ArrowRight: (n) => select(cursor + n), Home: () => select(0), End: () => select(count - 1),
      PageUp: () => select(shown[Math.max(nearestShown(cursor) - 1, 0)]), PageDown: () => select(shown[Math.min(nearestShown(cursor) + 1, shown.length - 1)]),
      a: () => turn(0.12, 0), d: () => turn(-0.12, 0), w: () => turn(0, 0.08), s: () => turn(0, -0.08), q: () => zoomScene(1.1), e: () => zoomScene(1 / 1.1), r: () => lookFrom("free", true),
      "+": () => zoomTime(0.5), "=": () => zoomTime(0.5), "-": () => zoomTime(2), 0: () => zoomTime(Infinity),
    };
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
      if (event.key === " " && !["BUTTON", "SUMMARY"].includes(event.target.tagName)) toggle();
      else if (Object.hasOwn(keys, event.key)) {
        if (event.key.startsWith("Arrow") || event.key.startsWith("Page") || event.key === "Home" || event.key === "End") pause();
        keys[event.key](event.shiftKey ? 10 : 1);
      } else return;
      event.preventDefault();
    });
  }

  // ---- words ----

  function tellFacts() {
    const seconds = count ? time[count - 1] - time[0] : 0;
    const known = count ? people[person].distance.filter((value) => value === value) : [];
    const off = known.length ? `${number((1000 * known.reduce((sum, value) => sum + value, 0)) / known.length)} mm` : "–";
    const facts = [[`${data.count}`, ` frames, ${number(seconds)} s`], ["", countsOf(person)], [off, " points to model"]];
    element("facts").replaceChildren(...facts.map(([value, text]) => make("li", {}, make("b", {}, value), text)));
  }

  function setUpWords() {
    if (people.length > 1) {
      people.forEach((_, i) => element("who").append(make("button", { type: "button", "aria-pressed": "false", onclick: () => choosePerson(i) }, `person ${i + 1}`)));
    }
    const sentences = [
      ...(summary.warnings || []).map((text) => ["Warning: ", text]), ...(summary.problems || []).map((text) => ["Problem: ", text]),
    ];
    if (count && people.every((one) => one.joints.every((value) => value === data.missing))) {
      sentences.unshift(["Nobody was found: ", "no frame has a pose. Look at the pictures: is a person whole in view, and different from the background?"]);
    }
    if (sentences.length) {
      const items = sentences.map(([kind, text]) => make("li", {}, make("b", {}, kind), text));
      const more = items.splice(sentences.length > 3 ? 2 : 3);
      element("notes").append(make("ul", {}, ...items));
      if (more.length) element("notes").append(make("details", { ontoggle: layOut }, make("summary", {}, `and ${more.length} more`), make("ul", {}, ...more)));
      element("notes").hidden = false;
    }
    setUpAbout();
  }

  function setUpAbout() {
    const versions = Object.entries(summary.versions || {}).map(([name, version]) => `${name} ${version}`).join(", ");
    const block = (title, ...children) => element("about").append(make("div", {}, make("h2", {}, title), ...children));
    block("This run", table([
      ["frames", data.count], ["status", countsOf(0) || "–"], ["with a pose", `${number(100 * (summary.answered || 0))} %`],
      ["points to model, mean ± sd", summary.point_to_model_m ? `${inMillimetres(summary.point_to_model_m.mean)} ± ${inMillimetres(summary.point_to_model_m.sd)} mm` : "–"],
      ...(summary.others || []).map((_, i) => [`status of person ${i + 2}`, countsOf(i + 1)]),
      ["rows of left and right images apart", summary.rows_apart_px === null || summary.rows_apart_px === undefined ? "–" : `${number(summary.rows_apart_px, 2)} px`],
      ["time taken", `${number(summary.seconds)} s, ${number(summary.seconds_per_frame, 2)} s a frame`],
      ["torchpose", summary.version || "–"], ["with", versions || "–"],
    ]));
    block(people.length > 1 ? "Size of person 1" : "Size of the person", make("p", { class: "quiet" }, "Lengths and girths as a share of the body file's own."),
      table(Object.entries(summary.size || {}).map(([name, share]) => [name.replaceAll("_", " "), `${number(100 * share)} %`])));
    const key = (name) => make("kbd", {}, name);
    const line = (...children) => make("li", {}, ...children);
    block("On this page", make("ul", {},
      ...data.thinned.map((text) => line(text)),
      line("Click or drag on a plot or on the time line: pictures, 3-D view and plots go to that moment. Numbers are degrees ± two standard deviations."),
      line(key("←"), " ", key("→"), " frame (with shift: 10), ", key("Home"), " ", key("End"), " ends, ", key("Page ↑"), " ", key("Page ↓"), " picture, ", key("space"), " plays."),
      line(key("+"), " ", key("−"), " ", key("0"), " zoom time, also ctrl-wheel on a plot. ", key("A"), " ", key("D"), " ", key("W"), " ", key("S"), " turn the 3-D view, ", key("Q"), " ", key("E"), " zoom it, ", key("R"), " resets it."),
      line("3-D axes as in poses.csv: x to the camera's right, y down, z away from it. " + (data.floor_seen ? "The grid lies on the floor that was found in the empty scene: feet off it are poses' errors, or its own." : "No floor was found: the grid is laid under the feet, as far as they have moved.")),
      line("The white part of the skeleton is the trunk. Frames without a pose are hatched: nothing is filled in.")));
    element("about").append(make("div", { class: "wide" }, make("details", {}, make("summary", {}, "Settings"), table(flat(summary.settings || {})))));
  }

  // ---- together ----

  function layOut() {
    drawPlots();
    drawTime();
    drawScene();
  }

  setUpWords();
  setUpScene();
  setUpPlots();
  setUpTime();
  setUpControl();
  choosePerson(0);
  layOut();
  new ResizeObserver(layOut).observe(element("screen"));
  document.body.dataset.ready = "yes";
})();
