"use strict";
// The report of a study: curves whose seeds tell their names, and tables that sort.

const data = JSON.parse(document.getElementById("data").textContent);
const INK = "#1b1f24";
const FONT = { family: "system-ui, sans-serif", color: INK, size: 12 };
const THIN = 1, BOLD = 3; // [px]

function draw(panel) {
  const plot = document.getElementById(panel.id);
  const curves = panel.curves.map(({ text, colour, dash, band, bold, x, y }) => ({
    x, y, type: "scatter", mode: band ? "none" : "lines", fill: band ? "toself" : undefined,
    fillcolor: `${colour}33`, opacity: bold || band ? 1 : 0.45, connectgaps: false,
    line: { color: colour, dash, width: bold ? BOLD : THIN },
    ...(band ? { hoverinfo: "skip" } : { hovertemplate: `${text}<br>%{x:,} timesteps: %{y}<extra></extra>` }),
  }));
  const axis = { gridcolor: "#e6e9ed", zeroline: false };
  const empty = !curves.some(({ y }) => y.some((value) => value !== null));
  const middle = { showarrow: false, xref: "paper", yref: "paper", x: 0.5, y: 0.5 };
  const layout = {
    annotations: empty ? [{ ...middle, text: "no seed has one" }] : [],
    font: FONT, showlegend: false, hovermode: "closest", height: 340,
    margin: { l: 52, r: 12, t: 30, b: 44 }, title: { text: panel.title, font: { size: 13 }, x: 0.02 },
    xaxis: { ...axis, title: { text: "timesteps learned from" } },
    yaxis: { ...axis, rangemode: panel.rangemode, ...(panel.range && { range: panel.range }) },
  };
  return Plotly.newPlot(plot, curves, layout, { responsive: true, displayModeBar: false });
}

// ---------------------------------------------------------------------------- tables that sort

const key = (row, column) => {
  const cell = row.cells[column];
  const number = cell.dataset.sort ?? cell.textContent.replaceAll(",", "");
  return Number.isNaN(parseFloat(number)) ? cell.textContent : parseFloat(number);
};

// Numbers come before words, such as the "-" of a seed without a lap.
function compare(one, other) {
  if (typeof one === typeof other) return one < other ? -1 : Number(one > other);
  return typeof one === "number" ? -1 : 1;
}

function sort(table, header) {
  const descending = header.ariaSort === "ascending";
  for (const other of table.querySelectorAll("th")) other.removeAttribute("aria-sort");
  header.ariaSort = descending ? "descending" : "ascending";
  const column = header.cellIndex;
  const rows = [...table.tBodies[0].rows];
  rows.sort((a, b) => compare(key(a, column), key(b, column)) * (descending ? -1 : 1));
  table.tBodies[0].append(...rows);
}

for (const table of document.querySelectorAll("table.sortable")) {
  for (const header of table.querySelectorAll("th")) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...header.childNodes);
    button.addEventListener("click", () => sort(table, header));
    header.append(button);
  }
}

plotlyReady.then(() => Promise.all(data.panels.map(draw))).then(() => {
  document.body.dataset.ready = performance.now().toFixed(0); // [ms] since the page was opened
});
