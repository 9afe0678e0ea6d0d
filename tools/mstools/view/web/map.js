// The north-up map: a canvas on which what the server describes is painted.
"use strict";

const FIX_COLORS = ["--used", "--rejected", "--monitored", "--undecided"];
// below this an ellipse is inside its dot, pixels
const LEAST_ELLIPSE = 3;
// width and height of a picture of the ground, in those of the map
const GROUND_SIZE = 1.5;

function createMap(section, fetchJson) {
  const canvas = section.querySelector("canvas");
  const readout = section.querySelector(".readout");
  const bar = section.querySelector(".scale");
  const pen = canvas.getContext("2d");
  // the view: null before the first answer
  let view = null;
  // whether it fits the track, until a person moves it
  let isFitted = true;
  let isFollowing = false;
  let data = null;
  let isFetching = false;
  let isStale = false;
  // "", "utm" or "geodetic"
  let grid = "";
  // the picture of the ground that is painted, and the one that is asked for: {image, view, size}
  let ground = null;
  let asked = null;
  let isGroundShown = true;
  // {at, heading, valid, level}, null without a pose
  let vehicle = null;

  const getSize = () => [canvas.clientWidth, canvas.clientHeight];

  function toPixels(place) {
    const [width, height] = getSize();
    return [width / 2 + (place[0] - view[0]) / view[2], height / 2 - (place[1] - view[1]) / view[2]];
  }

  function toPlace(x, y) {
    const [width, height] = getSize();
    return [view[0] + (x - width / 2) * view[2], view[1] - (y - height / 2) * view[2]];
  }

  async function refresh() {
    const [width, height] = getSize();
    if (section.hidden || !width || !height) return;
    if (isFetching) { isStale = true; return; }
    isFetching = true;
    const query = new URLSearchParams({ width, height });
    const before = view;
    if (view && !isFitted) for (const [n, name] of ["east", "north", "scale"].entries()) query.set(name, view[n]);
    if (grid) query.set("grid", grid);
    try {
      data = await fetchJson(`/map?${query}`);
      if (before === view) view = data.view;
      paint();
      askGround();
    } finally {
      isFetching = false;
      if (isStale) { isStale = false; refresh(); }
    }
  }

  // one picture at a time, of what is shown when the last one has come, with a margin to move in
  function askGround() {
    if (!isGroundShown || data.attribution === null || !data.origin || asked || isCovered()) return;
    const size = getSize().map((each) => Math.round(each * GROUND_SIZE));
    const wanted = { view, size, image: new Image() };
    asked = wanted;
    const end = (isThere) => {
      asked = null;
      if (isThere) ground = wanted;
      paint();
      if (isThere) askGround();
    };
    wanted.image.onload = () => end(true);
    wanted.image.onerror = () => end(false);
    wanted.image.src = `/background?${new URLSearchParams({
      east: view[0], north: view[1], scale: view[2], width: size[0], height: size[1],
    })}`;
  }

  function isCovered() {
    if (!ground || ground.view[2] !== view[2]) return false;
    return getSize().every((each, n) => Math.abs(view[n] - ground.view[n]) / view[2] <= (ground.size[n] - each) / 2);
  }

  // --- painting

  const readTone = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

  function trace(points) {
    pen.beginPath();
    for (const [n, place] of points.entries()) pen[n ? "lineTo" : "moveTo"](...toPixels(place));
  }

  function paint() {
    if (!view || !data) return;
    const [width, height] = getSize();
    const density = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(width * density)) canvas.width = Math.round(width * density);
    if (canvas.height !== Math.round(height * density)) canvas.height = Math.round(height * density);
    pen.setTransform(density, 0, 0, density, 0, 0);
    pen.clearRect(0, 0, width, height);
    pen.font = "11px system-ui, sans-serif";
    if (isGroundShown && ground) paintGround();
    for (const line of data.grid) paintLine(line);
    paintFixes();
    pen.lineWidth = 2;
    for (const [n, line] of data.trail.entries()) {
      pen.strokeStyle = readTone(line.valid ? "--valid" : "--invalid");
      // the vehicle is shown more often than the rest
      trace(vehicle && n === data.trail.length - 1 ? [...line.points, vehicle.at] : line.points);
      pen.stroke();
    }
    for (const [name, place] of Object.entries(data.places)) paintPlace(name, place);
    if (vehicle) paintVehicle();
    paintScale();
    describe();
  }

  // a picture of an earlier view is moved and scaled until the next one comes
  function paintGround() {
    const [east, north, scale] = ground.view;
    const [width, height] = ground.size.map((each) => (each * scale) / view[2]);
    const [x, y] = toPixels([east, north]);
    pen.drawImage(ground.image, x - width / 2, y - height / 2, width, height);
  }

  function paintLine(line) {
    const [width, height] = getSize();
    pen.strokeStyle = readTone("--grid");
    pen.lineWidth = 0.7;
    trace(line.points);
    pen.stroke();
    const places = line.points.map(toPixels);
    // where the line enters the view: below, or at the left
    const number = places.findIndex(([x, y]) => (line.is_upright ? y <= height : x >= 0));
    if (number < 0) return;
    const [x, y] = places[number];
    const room = line.is_upright ? [x + 3, height - 34] : [4, y - 3];
    paintText(line.label, "--ink", ...room);
  }

  // text that can be read on a picture
  function paintText(text, tone, x, y) {
    pen.lineWidth = 3;
    pen.strokeStyle = readTone("--paper");
    pen.strokeText(text, x, y);
    pen.fillStyle = readTone(tone);
    pen.fillText(text, x, y);
  }

  function paintFixes() {
    for (const [east, north, color, varE, varN, cov] of data.fixes) {
      const [x, y] = toPixels([east, north]);
      pen.fillStyle = pen.strokeStyle = readTone(FIX_COLORS[color]);
      pen.beginPath();
      pen.arc(x, y, 2.5, 0, 2 * Math.PI);
      pen.fill();
      if (varE === null) continue;
      const middle = (varE + varN) / 2;
      const half = Math.hypot((varE - varN) / 2, cov);
      const [long, short] = [middle + half, middle - half].map((each) => Math.sqrt(Math.max(each, 0)) / view[2]);
      if (long < LEAST_ELLIPSE) continue;
      pen.lineWidth = 0.7;
      pen.beginPath();
      // pixels go down: the angle turns the other way
      pen.ellipse(x, y, long, short, -0.5 * Math.atan2(2 * cov, varE - varN), 0, 2 * Math.PI);
      pen.stroke();
    }
  }

  function paintPlace(name, place) {
    const [x, y] = toPixels(place);
    pen.fillStyle = readTone("--place");
    pen.beginPath();
    pen.arc(x, y, 4, 0, 2 * Math.PI);
    pen.fill();
    paintText(name, "--place", x + 7, y + 12);
  }

  function paintVehicle() {
    const [x, y] = toPixels(vehicle.at);
    const tone = vehicle.valid ? readTone("--vehicle") : readTone("--invalid");
    pen.strokeStyle = pen.fillStyle = tone;
    pen.lineWidth = 1.5;
    if (vehicle.level !== null) {
      pen.beginPath();
      pen.arc(x, y, vehicle.level / view[2], 0, 2 * Math.PI);
      pen.stroke();
    }
    pen.save();
    pen.translate(x, y);
    pen.rotate((vehicle.heading * Math.PI) / 180);
    pen.beginPath();
    pen.moveTo(0, -11);
    pen.lineTo(7, 8);
    pen.lineTo(0, 4);
    pen.lineTo(-7, 8);
    pen.closePath();
    pen.fill();
    pen.strokeStyle = readTone("--paper");
    pen.lineWidth = 1;
    pen.stroke();
    pen.restore();
  }

  // a bar of 1, 2 or 5 times a power of ten, 60 to 150 pixels long
  function paintScale() {
    const longest = 150 * view[2];
    const power = 10 ** Math.floor(Math.log10(longest));
    const meters = power * [5, 2, 1].find((each) => each * power <= longest);
    bar.querySelector("i").style.width = `${meters / view[2]}px`;
    bar.querySelector("span").textContent = meters >= 1000 ? `${meters / 1000} km` : `${meters} m`;
  }

  function describe() {
    canvas.dataset.fixes = data.fixes.length;
    canvas.dataset.meters = view[2];
    canvas.dataset.grid = data.grid.length;
    canvas.dataset.ground = ground ? ground.view.join() : "";
    section.querySelector("[data-do=ground]").hidden = data.attribution === null;
    section.querySelector(".attribution").textContent = (isGroundShown && data.attribution) || "";
    if (vehicle) canvas.dataset.vehicle = toPixels(vehicle.at).join(",");
    canvas.setAttribute("aria-label", `North-up map: ${data.fixes.length} fixes`);
  }

  function readPlace(x, y) {
    const [east, north] = toPlace(x, y);
    const { origin } = data;
    if (!origin) return `E ${east.toFixed(2)} m, N ${north.toFixed(2)} m from the origin`;
    const [u, v] = [(east - data.view[0]) / origin.half, (north - data.view[1]) / origin.half];
    const apply = (c) => c[0] + c[1] * u + c[2] * v + c[3] * u * u + c[4] * u * v + c[5] * v * v;
    const utm = `UTM ${origin.zone}  E ${(origin.easting + east).toFixed(2)}  N ${(origin.northing + north).toFixed(2)}`;
    return `${utm}   ${apply(origin.latitude).toFixed(7)}, ${apply(origin.longitude).toFixed(7)}`;
  }

  // --- pointer

  function zoom(factor, x, y) {
    if (!view) return;
    const before = toPlace(x, y);
    const scale = Math.min(Math.max(view[2] * factor, 1e-3), 1000);
    view = [view[0], view[1], scale];
    const after = toPlace(x, y);
    show([view[0] + before[0] - after[0], view[1] + before[1] - after[1], scale]);
  }

  const zoomMiddle = (factor) => zoom(factor, ...getSize().map((each) => each / 2));

  function setFollow(value) {
    isFollowing = value;
    if (value) isFitted = false;
    if (value && vehicle && view) view = [...vehicle.at, view[2]];
    section.querySelector("[data-do=follow]").setAttribute("aria-pressed", value);
    refresh();
  }

  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoom(Math.exp(event.deltaY * 0.0015), event.offsetX, event.offsetY);
  }, { passive: false });
  const held = new Map();
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.offsetX, event.offsetY]);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!view || !data) return;
    const now = [event.offsetX, event.offsetY];
    readout.textContent = readPlace(...now);
    const last = held.get(event.pointerId);
    if (!last) return;
    held.set(event.pointerId, now);
    if (held.size === 1) {
      if (isFollowing) setFollow(false);
      show([view[0] - (now[0] - last[0]) * view[2], view[1] + (now[1] - last[1]) * view[2], view[2]]);
    } else {
      // two fingers: the distance to the other one zooms
      const other = [...held].find(([id]) => id !== event.pointerId)[1];
      const length = (place) => Math.hypot(place[0] - other[0], place[1] - other[1]);
      zoom(length(last) / Math.max(length(now), 1), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
    }
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
  canvas.addEventListener("keydown", (event) => {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.key === "+") zoomMiddle(0.7);
    else if (event.key === "-") zoomMiddle(1.4);
    else if (steps && view) show([view[0] + steps[0] * 60 * view[2], view[1] + steps[1] * 60 * view[2], view[2]]);
    else return;
    event.preventDefault();
    event.stopPropagation();
  });
  const actions = {
    fit: () => { isFitted = true; setFollow(false); },
    follow: () => setFollow(!isFollowing),
    grid: () => {
      grid = { "": "utm", utm: "geodetic", geodetic: "" }[grid];
      const button = section.querySelector("[data-do=grid]");
      button.textContent = { "": "Grid", utm: "Grid: UTM", geodetic: "Grid: degrees" }[grid];
      button.setAttribute("aria-pressed", grid !== "");
      refresh();
    },
    ground: () => {
      isGroundShown = !isGroundShown;
      section.querySelector("[data-do=ground]").setAttribute("aria-pressed", isGroundShown);
      paint();
      askGround();
    },
    in: () => zoomMiddle(0.6),
    out: () => zoomMiddle(1 / 0.6),
  };
  for (const button of section.querySelectorAll("[data-do]"))
    button.addEventListener("click", () => actions[button.dataset.do]());
  new ResizeObserver(() => { paint(); refresh(); }).observe(canvas);

  // of the page's state, which comes more often than what /map has
  function setVehicle({ place, heading, valid, level }) {
    vehicle = place ? { at: place, heading: heading ?? 0, valid, level: level ?? null } : null;
    if (isFollowing && vehicle && view) view = [...vehicle.at, view[2]];
    if (section.hidden) return;
    paint();
    if (view && data) askGround();
  }

  // shows a place: east, north, meters of a pixel
  function show(place) {
    isFitted = false;
    view = place;
    paint();
    refresh();
  }

  return { refresh, paint, setVehicle, show, toPixels };
}
