// The page: one web socket in, everything drawn from its frames; connects again when the server comes back.

import {Controls} from "/static/controls.js";
import {Drive} from "/static/drive.js";
import {showBoard, showModel, showLog, showLoop, showSafety} from "/static/panels.js";
import {Player} from "/static/player.js";
import {Traces} from "/static/traces.js";

const RETRY_MS = 1000;
// The server closes the pages that were without use for longest when too many are open: this one says that it is in use.
const PRESENT_MS = 1000;
const REPLACED = 1013;
const element = id => document.getElementById(id);
const page = {hello: null, socket: null, frames: 0, newest: null, scene: null, jumps: 0, origin: null};
window.seldinger = page;

const send = message => {
  if (page.socket?.readyState !== WebSocket.OPEN) return false;
  page.socket.send(JSON.stringify(message));
  return true;
};
const controls = new Controls(element("controls"), send);
const drive = new Drive(element("drive"), controls);

function write(place, text) {
  if (place.textContent !== text) place.textContent = text;
}

function link(text, state) {
  write(element("link"), text);
  if (element("link").dataset.state !== state) element("link").dataset.state = state;
}

const force = new Traces(element("force-card").querySelector("canvas"), [{
  label: "", unit: "N", scale: 1, digits: 3, least: 0.1, lines: [
    {name: "estimate", label: "estimate", color: "estimate", band: true},
    {name: "wanted", label: "set-point", color: "target", dash: [5, 4]}, {name: "force", label: "in the loop", color: "force"}]}]);
const pose = new Traces(element("pose-card").querySelector("canvas"), ["e1", "e2", "e3"].map((axis, index) => ({
  label: axis, unit: "mm", scale: 1000, digits: 2, least: 0.002, lines: [
    {name: `target${index}`, label: "target", color: "target", dash: [5, 4]}, {name: `tip${index}`, label: "tip", color: "catheter"}]})));

async function begin(hello) {
  page.hello = hello;
  document.title = `seldinger ${hello.kind}: ${hello.rig}`;
  element("rig").textContent = [hello.rig, hello.catheter, hello.file].filter(Boolean).join(" · ");
  element("controls").hidden = element("drive").hidden = hello.kind !== "live";
  if (hello.kind === "live") drive.begin(hello);
  force.lanes[0].limit = hello.over_force_N;
  if (hello.kind === "play" && !page.player) {
    page.player = new Player(hello, send);
    for (const traces of [force, pose]) Object.assign(traces, {windows: hello.windows, origin: hello.begin});
    page.origin = hello.begin;
  }
  for (const traces of [force, pose]) traces.clear();
  addRows(hello.past.rows, hello.past.estimates, "");
  if (page.origin === null && hello.past.rows.length) page.origin = hello.past.rows[0][0];
  showLog(hello.past.log, page.origin || 0);
  if (!page.scene) {
    try {
      const {Scene} = await import("/static/scene.js");
      page.scene = new Scene(element("scene"), hello.radius_m);
      element("reset-view").addEventListener("click", () => page.scene.resetView());
      element("scene").addEventListener("dblclick", event => {
        if (hello.kind === "live") drive.picked(page.scene.pick(event.clientX, event.clientY));
      });
    } catch (error) {
      element("scene-note").textContent = `No 3-D view in this browser: ${error.message}`;
      page.scene = {show() {}, broken: true};
    }
  }
}

function addRows(rows, estimates, mode) {
  for (const [t, value, wanted, ...places] of rows) {
    force.add("force", t, value);
    force.add("wanted", t, wanted);
    for (let axis = 0; axis < 3; axis++) {
      pose.add(`tip${axis}`, t, places[axis]);
      pose.add(`target${axis}`, t, mode === "disarmed" || mode === "homing" ? null : places[3 + axis]);
    }
  }
  for (const [t, value, deviation] of estimates) force.add("estimate", t, value, value === null ? null : 2 * deviation);
}

function take(frame) {
  page.frames += 1;
  if (frame.jumps !== undefined && frame.jumps !== page.jumps) {
    page.jumps = frame.jumps;
    force.clear();
    pose.clear();
  }
  addRows(frame.rows, frame.estimates, frame.mode);
  if (page.origin === null && frame.t) page.origin = frame.t;
  if (frame.log) showLog(frame.log, page.origin || 0);
  page.newest = frame;
  if (!page.waiting) {
    page.waiting = true;
    requestAnimationFrame(draw);
  }
}

function draw() {
  page.waiting = false;
  const frame = page.newest, live = page.hello.kind === "live";
  showSafety(frame, live);
  if (live) drive.show(frame);
  showLoop(frame.loop, frame);
  showBoard(frame.board);
  showModel(frame.model);
  if (frame.play) page.player.show(frame.play);
  const now = frame.play ? frame.play.at : frame.t;
  force.draw(now);
  pose.draw(now);
  if (page.scene && !page.scene.broken) {
    page.scene.show(frame.scene, frame.mode, frame.plan);
    const gap = frame.scene.gap_m;
    const pressed = frame.plan?.pressed;
    element("legend-plan").hidden = !frame.plan;
    element("legend-loaded").hidden = !pressed;
    const step = frame.plan ? `Plan, step ${frame.plan.step + 1} of ${frame.plan.shapes.length}. ` +
      (pressed ? `Planned force at the goal ${Math.hypot(...pressed.force).toFixed(2)} N. ` : "") : "";
    write(element("scene-note"), step + "Grid 10 mm; force arrow 5 mm for 0.1 N." + (gap === null ? "" : ` Model and tracker differ by ${(gap * 1000).toFixed(1)} mm at the tip.`));
  }
  link(live ? (frame.silent_s !== null && frame.silent_s <= 1 ? "live" : "no data") : "recording", !live || (frame.silent_s !== null && frame.silent_s <= 1) ? "good" : "bad");
}

function connect() {
  const socket = page.socket = new WebSocket(`ws://${location.host}/rig`);
  let ready = Promise.resolve();
  socket.addEventListener("message", event => {
    const message = JSON.parse(event.data);
    if (message.hello) ready = begin(message.hello);
    else if (message.answer && message.answer.action !== "play") {
      if (!drive.answered(message.answer)) controls.answered(message.answer);
    }
    else if (message.frame) ready.then(() => take(message.frame));
  });
  const present = () => socket.readyState === WebSocket.OPEN && socket.send('"present"');
  socket.addEventListener("open", present);
  const telling = setInterval(present, PRESENT_MS);
  socket.addEventListener("close", event => {
    drive.release(false);
    controls.lost();
    clearInterval(telling);
    link(event.reason || "no server", "bad");
    if (event.code !== REPLACED) setTimeout(connect, RETRY_MS);
  });
}

connect();
