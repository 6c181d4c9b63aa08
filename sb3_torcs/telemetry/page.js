"use strict";
// The lap report: charts over one axis of distance, a map, and cars that move with the pointer.
// Cars stand where each driver is at the moment when the first driver is at the pointer.

const numbers = (text) => // as page.py packs them
  new Float32Array(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);

const data = JSON.parse(document.getElementById("data").textContent);
const distance = numbers(data.distance);
const drivers = data.drivers.map((driver) => {
  const columns = Object.entries(driver.columns).map(([name, text]) => [name, numbers(text)]);
  return { ...driver, ...Object.fromEntries(columns) };
});
const [first] = drivers;
const stacked = [...drivers].reverse(); // as they are drawn: the first one on top
const lapLength = distance[distance.length - 1];
const longest = Math.max(...drivers.map((driver) => driver.time[driver.time.length - 1]));
const touch = matchMedia("(pointer: coarse)").matches;
const byId = (name) => document.getElementById(name);
const [charts, map, cursor, slider, play, follow] =
  ["charts", "map", "cursor", "slider", "play", "follow"].map(byId);
const INK = "#1b1f24";
const FONT = { family: "system-ui, sans-serif", color: INK, size: 12 };
const CONFIG = { responsive: true, displayModeBar: false, doubleClick: "reset" };

// ---------------------------------------------------------------------------- interpolation

// The index before a value in a growing column, and how far the value is on to the next one.
function between(column, value) {
  let low = 0, high = column.length - 1;
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (column[middle] <= value) low = middle; else high = middle;
  }
  const step = column[high] - column[low];
  return [low, step > 0 ? Math.min(Math.max((value - column[low]) / step, 0), 1) : 0];
}

const at = (column, [index, share]) =>
  column[index] + share * (column[Math.min(index + 1, column.length - 1)] - column[index]);

// ---------------------------------------------------------------------------- charts

const PANELS = [ // title, height, columns
  ["speed [km/h]", 3, ["speed"]],
  [`time behind ${first.name} [s]`, 2, ["delta"]],
  ["throttle (up), brake (down)", 1.6, ["throttle", "brake"]],
  ["steering, left up", 1.2, ["steering"]],
  ["gear", 1, ["gear"]],
  ["place across the road, left edge 1, right edge −1", 1.4, ["position"]],
  ["wheel slip, spinning up, locking down", 1.2, ["slip"]],
].filter(([, , [column]]) => column !== "delta" || drivers.length > 1);
const HEIGHT = window.innerWidth > 900 ? 1180 : 1050; // [px]
const GAP = 0.028; // between two panels, of the whole height
const MARGIN = { l: 44, r: 12, t: 26, b: 40 };
const LIMITS = { position: [-1.15, 1.15], throttle: [-1.05, 1.05], steering: [-1.05, 1.05] };

function drawCharts() {
  const layout = {
    font: FONT, margin: MARGIN, showlegend: false, hovermode: false,
    dragmode: touch ? false : "zoom", height: HEIGHT,
    plot_bgcolor: "#fff", paper_bgcolor: "#fff", shapes: [], annotations: [],
    xaxis: {
      range: [0, lapLength], anchor: `y${PANELS.length}`, gridcolor: "#e6e9ed", zeroline: false,
      title: { text: "distance from the line [m]", standoff: 6 }, fixedrange: touch,
    },
  };
  const traces = [];
  const total = PANELS.reduce((sum, [, height]) => sum + height, 0);
  const unit = (1 - GAP * (PANELS.length - 1)) / total;
  let top = 1;
  PANELS.forEach(([title, height, columns], number) => {
    const axis = number === 0 ? "y" : `y${number + 1}`;
    const bottom = top - height * unit;
    layout[axis.replace("y", "yaxis")] = {
      domain: [Math.max(bottom, 0), top], anchor: "x", fixedrange: true, gridcolor: "#e6e9ed",
      zerolinecolor: "#aab2bc", nticks: 5, ...(LIMITS[columns[0]] && { range: LIMITS[columns[0]] }),
    };
    layout.annotations.push({
      text: title, x: 0, xref: "paper", xanchor: "left", y: top, yref: "paper", yanchor: "bottom",
      showarrow: false, font: { ...FONT, size: 12 },
    });
    for (const column of columns) {
      for (const driver of stacked) {
        traces.push({
          type: "scatter", mode: "lines", x: distance, yaxis: axis, name: driver.name,
          y: column === "brake" ? driver[column].map((value) => -value) : driver[column],
          line: {
            color: driver.colour, width: driver === first ? 1.9 : 1.5, dash: driver.dash,
            shape: column === "gear" ? "hv" : "linear",
          },
        });
      }
    }
    top = bottom - GAP;
  });
  data.corners.forEach((corner) => {
    layout.shapes.push({
      type: "rect", layer: "below", xref: "x", x0: corner.begin, x1: corner.end, yref: "paper",
      y0: 0, y1: 1, fillcolor: "rgba(27, 31, 36, 0.06)", line: { width: 0 },
    });
  });
  return Plotly.newPlot(charts, traces, layout, CONFIG);
}

// ---------------------------------------------------------------------------- map

let cars = 0; // the trace that holds them
const WHOLE = (({ left, right }) => {
  const range = (axis) => {
    const values = [...left[axis], ...right[axis]];
    const [low, high] = [Math.min(...values), Math.max(...values)];
    return [low - 0.06 * (high - low) - 15, high + 0.06 * (high - low) + 15];
  };
  return { "xaxis.range": range("x"), "yaxis.range": range("y") };
})(data.road);

const NEAR = 50; // [m] around the first car, while the map follows it

const around = (x, y, reach) => (
  { "xaxis.range": [x - reach, x + reach], "yaxis.range": [y - reach, y + reach] });

function drawMap() {
  const { left, right, line } = data.road;
  const hidden = { visible: false, fixedrange: touch };
  const road = {
    x: [...left.x, ...[...right.x].reverse()], y: [...left.y, ...[...right.y].reverse()],
    fill: "toself", fillcolor: "#dfe3e8", mode: "lines", line: { width: 0 },
  };
  const edges = [left, right].map((edge) => (
    { ...edge, mode: "lines", line: { color: "#8b94a0", width: 1 } }));
  const lines = stacked.map((driver) => ({
    x: driver.x, y: driver.y, mode: "lines", name: driver.name,
    line: { color: driver.colour, width: 1.8, dash: driver.dash },
  }));
  const numbered = {
    x: data.corners.map((corner) => corner.x), y: data.corners.map((corner) => corner.y),
    text: data.corners.map((_, number) => `${number + 1}`), mode: "text",
    textfont: { ...FONT, size: 10, color: "#5b6470" },
  };
  const start = { ...line, mode: "lines", line: { color: INK, width: 3 } };
  const marked = {
    x: stacked.map((driver) => driver.x[0]), y: stacked.map((driver) => driver.y[0]),
    mode: "markers",
    marker: {
      color: stacked.map((driver) => driver.colour), size: 13, line: { color: "#fff", width: 2 },
    },
  };
  const traces = [road, ...edges, start, ...lines, numbered, marked];
  cars = traces.length - 1;
  const layout = {
    font: FONT, margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, hovermode: false,
    dragmode: touch ? false : "pan", xaxis: { ...hidden, range: WHOLE["xaxis.range"] },
    yaxis: { ...hidden, range: WHOLE["yaxis.range"], scaleanchor: "x" },
  };
  return Plotly.newPlot(map, traces, layout, { ...CONFIG, scrollZoom: !touch });
}

// ---------------------------------------------------------------------------- numbers of corners

const ROOM = 15; // [px] for a number

// Choose the numbers that do not stand on others.
function apart(places) {
  const chosen = [];
  return places.map(([x, y]) => {
    const free = chosen.every(([a, b]) => Math.hypot(x - a, y - b) >= ROOM);
    if (free) chosen.push([x, y]);
    return free;
  });
}

function numberCharts() {
  const [from, to] = shown();
  const places = data.corners.map((corner) =>
    [MARGIN.l + ((corner.begin + corner.end) / 2 - from) / (to - from) * inner(), 0]);
  const free = apart(places);
  byId("numbers").replaceChildren(...places.flatMap(([x], number) => {
    if (!free[number] || x < MARGIN.l || x > MARGIN.l + inner()) return [];
    const label = document.createElement("span");
    label.textContent = number + 1;
    label.style.left = `${x}px`;
    return [label];
  }));
}

let scale = 0; // [m/px] of the map when it was numbered

function numberMap() {
  const [low, high] = map.layout.xaxis.range;
  const now = (high - low) / map.clientWidth;
  if (Math.abs(now / scale - 1) < 0.2) return;
  scale = now;
  const free = apart(data.corners.map((corner) => [corner.x / scale, corner.y / scale]));
  Plotly.restyle(map, { text: [free.map((yes, number) => (yes ? `${number + 1}` : ""))] }, [cars - 1]);
}

// ---------------------------------------------------------------------------- the moment

let moment = 0; // [s] since the lap began
let drawn = true;

// The range of distance that the charts show, and where it lies on the screen.
const shown = () => charts.layout.xaxis.range.map(Number);
const inner = () => (charts.layout.width || charts.clientWidth) - MARGIN.l - MARGIN.r;

function show(time) {
  moment = Math.min(Math.max(time, 0), longest);
  if (drawn) requestAnimationFrame(draw);
  drawn = false;
}

function draw() {
  drawn = true;
  const where = at(distance, between(first.time, moment));
  const here = between(distance, where);
  const [from, to] = shown();
  const share = (where - from) / (to - from);
  cursor.style.left = `${MARGIN.l + share * inner()}px`;
  cursor.style.height = `${charts.clientHeight - MARGIN.b}px`;
  cursor.hidden = share < 0 || share > 1;
  slider.value = moment / longest;
  byId("where").textContent = `${moment.toFixed(2)} s, ${where.toFixed(0)} m`;
  const places = stacked.map((driver) => between(driver.time, moment));
  const [x, y] = ["x", "y"].map((axis) => stacked.map((driver, n) => at(driver[axis], places[n])));
  if (follow.checked) Plotly.relayout(map, around(x[x.length - 1], y[y.length - 1], NEAR));
  Plotly.animate(
    map,
    { data: [{ x, y }], traces: [cars] },
    { mode: "immediate", frame: { duration: 0, redraw: false }, transition: { duration: 0 } },
  );
  drivers.forEach((driver, number) => {
    const cells = byId(`driver-${number}`).cells;
    const value = (column, digits) => at(driver[column], here).toFixed(digits);
    cells[1].textContent = value("speed", 0);
    cells[2].textContent = driver.gear[here[0]].toFixed(0);
    cells[3].textContent = value("throttle", 2);
    cells[4].textContent = value("brake", 2);
    cells[5].textContent = driver === first ? "" : signed(at(driver.delta, here));
  });
}

const signed = (value) => `${value < 0 ? "−" : "+"}${Math.abs(value).toFixed(3)}`;

// ---------------------------------------------------------------------------- play

let before = null; // [ms] when the last picture was drawn; null while it stands

function advance(now) {
  if (before === null) return;
  const next = moment + Number(byId("rate").value) * (now - before) / 1000;
  before = now;
  show(next);
  if (next >= longest) pause(); else requestAnimationFrame(advance);
}

function pause() {
  before = null;
  play.textContent = "▶ Play";
}

function start() {
  if (moment >= longest) show(0);
  before = performance.now();
  play.textContent = "❚❚ Pause";
  requestAnimationFrame(advance);
}

// ---------------------------------------------------------------------------- what people do

function point(event) {
  const [from, to] = shown();
  const share = (event.clientX - charts.getBoundingClientRect().left - MARGIN.l) / inner();
  if (share < 0 || share > 1) return;
  pause();
  show(at(first.time, between(distance, from + share * (to - from))));
}

function zoom(number) { // to a corner; without a number back to the whole lap
  const corner = data.corners[number];
  const range = corner
    ? [Math.max(corner.begin - 120, 0), Math.min(corner.end + 80, lapLength)] : [0, lapLength];
  const reach = corner && Math.max(60, corner.end - corner.begin);
  follow.checked = false;
  Plotly.relayout(charts, { "xaxis.range": range });
  Plotly.relayout(map, corner ? around(corner.x, corner.y, reach) : WHOLE);
  if (corner) show(at(first.time, between(distance, corner.begin)));
}

function listen() {
  charts.parentElement.addEventListener("pointermove", point);
  charts.parentElement.addEventListener("pointerdown", point);
  const changed = () => { numberCharts(); show(moment); };
  charts.on("plotly_relayout", changed);
  new ResizeObserver(changed).observe(charts);
  map.on("plotly_relayout", numberMap);
  slider.addEventListener("input", () => { pause(); show(slider.value * longest); });
  play.addEventListener("click", () => (before === null ? start() : pause()));
  follow.addEventListener("change", () => {
    if (!follow.checked) Plotly.relayout(map, WHOLE);
    show(moment);
  });
  byId("whole").addEventListener("click", () => zoom());
  document.querySelectorAll("tbody.group").forEach((group, number) => {
    const go = () => { zoom(number); map.scrollIntoView({ block: "nearest" }); };
    group.addEventListener("click", go);
    group.addEventListener("keydown", (event) => { if (event.key === "Enter") go(); });
  });
  const resize = (width, height) => () => {
    Plotly.relayout(charts, { width, height, autosize: !width });
    Plotly.relayout(map, { width, height: width && width / 2, autosize: !width });
  };
  addEventListener("beforeprint", resize(690, 860)); // [px] what of A4 is within its margins
  addEventListener("afterprint", resize(null, HEIGHT));
}

plotlyReady.then(() => Promise.all([drawCharts(), drawMap()])).then(() => {
  listen();
  numberCharts();
  numberMap();
  show(0);
  document.body.dataset.ready = performance.now().toFixed(0); // [ms] since the page was opened
});
