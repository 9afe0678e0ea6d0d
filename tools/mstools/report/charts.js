// Charts of plotly.js on a page: one time on all of them, one zoom of all time axes, light and dark.
"use strict";

const root = document.documentElement;
// the drawn ones
const charts = [];
const isOverTime = (chart) => chart.hasAttribute("data-time");
// the buttons are listed: among plotly's own is one that sends a chart to a server
const CONFIG = {
  responsive: true, displaylogo: false, plotlyServerURL: "",
  modeBarButtons: [["toImage", "zoom2d", "pan2d", "zoomIn2d", "zoomOut2d", "resetScale2d"]],
};

// --- light and dark

function readColor(name) {
  return getComputedStyle(root).getPropertyValue(name).trim();
}

function makeColors(layout) {
  const changes = {
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: readColor("--wash"), "font.color": readColor("--ink"),
    "hoverlabel.bgcolor": readColor("--paper"), "hoverlabel.font.color": readColor("--ink"),
    "modebar.bgcolor": "rgba(0,0,0,0)", "modebar.color": readColor("--soft"), "modebar.activecolor": readColor("--ink"),
  };
  for (const key of Object.keys(layout).filter((name) => /^[xy]axis/.test(name)))
    for (const part of ["gridcolor", "linecolor", "zerolinecolor"]) changes[`${key}.${part}`] = readColor("--line");
  return changes;
}

function colorCharts() {
  for (const chart of charts) Plotly.relayout(chart, makeColors(chart.layout));
}

// --- one time on all charts

function addMark(chart, name) {
  const mark = document.createElement("div");
  mark.className = name;
  chart.append(mark);
  return mark;
}

function showMark(chart, name, time) {
  const axis = chart._fullLayout.xaxis;
  const size = chart._fullLayout._size;
  const at = axis.l2p(time);
  const mark = chart.querySelector(`.${name}`);
  if (!mark) return;
  const isInside = at >= 0 && at <= axis._length;
  Object.assign(mark.style, {
    display: isInside ? "block" : "none", left: `${size.l + at}px`, top: `${size.t}px`, height: `${size.h}px`,
  });
}

function findPlace(chart, time) {
  let best = null;
  for (const trace of chart._fullData) {
    if (!trace.customdata || trace.mode !== "lines") continue;
    trace.customdata.forEach((each, number) => {
      if (each === null) return;
      const distance = Math.abs(each - time);
      if (best === null || distance < best.distance) best = { distance, x: trace.x[number], y: trace.y[number] };
    });
  }
  return best;
}

function showSpot(chart, time) {
  const place = findPlace(chart, time);
  if (place === null) return;
  const { xaxis, yaxis } = chart._fullLayout;
  Object.assign(chart.querySelector(".spot").style, {
    display: "block", left: `${xaxis._offset + xaxis.l2p(place.x)}px`, top: `${yaxis._offset + yaxis.l2p(place.y)}px`,
  });
}

function showTime(time) {
  root.dataset.time = time;
  for (const chart of charts) {
    if (isOverTime(chart)) showMark(chart, "cursor", time);
    else showSpot(chart, time);
  }
}

// the time below the pointer, null beside the panels
function readTime(chart, event) {
  const at = event.clientX - chart.getBoundingClientRect().left - chart._fullLayout._size.l;
  const axis = chart._fullLayout.xaxis;
  return at >= 0 && at <= axis._length ? axis.p2l(at) : null;
}

// the pointer's time: plotly's own hover events are of drawn points, and there is none between two bars
function followPointer(chart) {
  let last = null;
  chart.addEventListener("mousemove", (event) => {
    if (last === null) requestAnimationFrame(() => {
      const time = readTime(chart, last);
      last = null;
      if (time !== null) showTime(time);
    });
    last = event;
  });
}

function followPoints(chart) {
  chart.on("plotly_hover", (event) => {
    const time = event.points[0].customdata ?? null;
    if (time !== null) showTime(time);
  });
}

// --- one zoom of all time axes

let isLinking = false;

async function linkZoom(source, change) {
  if (isLinking || !Object.keys(change).some((key) => key.startsWith("xaxis"))) return;
  isLinking = true;
  const range = [...source._fullLayout.xaxis.range];
  const others = charts.filter((chart) => chart !== source && isOverTime(chart));
  await Promise.all(others.map((chart) => Plotly.relayout(chart, { "xaxis.range": range })));
  isLinking = false;
}

// --- drawing

function setColors(layout) {
  for (const [path, value] of Object.entries(makeColors(layout))) {
    const names = path.split(".");
    const last = names.pop();
    names.reduce((part, name) => (part[name] ??= {}), layout)[last] = value;
  }
  return layout;
}

async function updateChart(chart, figure) {
  chart.style.height = `${figure.layout.height}px`;
  await Plotly.react(chart, figure.data, setColors(figure.layout), CONFIG);
}

async function drawChart(chart, figure) {
  chart.style.height = `${figure.layout.height}px`;
  await Plotly.newPlot(chart, figure.data, setColors(figure.layout), CONFIG);
  charts.push(chart);
  addMark(chart, isOverTime(chart) ? "cursor" : "spot");
  if (isOverTime(chart)) {
    followPointer(chart);
    chart.on("plotly_relayout", (change) => linkZoom(chart, change));
  } else followPoints(chart);
}
