// What the numbers mean in words: safety, loop timing, firmware, log.

const ACTIONS = {none: "No fault", warn: "Warning", hold: "Holding", retract: "Retracting", stop: "Stopped"};
const MODES = {disarmed: "Disarmed", hold: "Holding", position: "Moving", approach: "Approach", contact: "Contact",
  retract: "Retract", stopped: "Stopped", jog: "Jog", homing: "Homing"};
const IDLE = {disarmed: "The stages do not move until the rig is armed.",
  hold: "Armed and holding.",
  stopped: "Stopped. Disarm and arm to move again.",
  homing: "An axis moves to its home switch. Stop, Hold and Disarm end it."};

const element = id => document.getElementById(id);

function fill(list, rows) {
  while (list.children.length > 2 * rows.length) list.lastChild.remove();
  rows.forEach(([name, value, state], index) => {
    if (list.children.length <= 2 * index) list.append(document.createElement("dt"), document.createElement("dd"));
    const [term, text] = [list.children[2 * index], list.children[2 * index + 1]];
    if (term.textContent !== name) term.textContent = name;
    if (text.textContent !== value) text.textContent = value;
    if (text.dataset.state !== (state || "")) text.dataset.state = state || "";
  });
}

const us = value => value === null || value === undefined ? "–" : value >= 1000 ? `${(value / 1000).toFixed(1)} ms` : `${value.toFixed(0)} µs`;
const whole = value => (value ?? 0).toLocaleString("en-US").replaceAll(",", " ");
const count = value => [whole(value), value ? "bad" : ""];

function set(id, text) {
  const place = element(id);
  if (place.textContent !== text) place.textContent = text;
}

export function showSafety(frame, live) {
  const silent = live && (frame.silent_s === null || frame.silent_s > 1);
  const action = silent ? "silent" : frame.action === "none" && frame.first ? "stop" : frame.action;
  if (element("safety").dataset.action !== action) element("safety").dataset.action = action;
  const held = frame.action === "none" && frame.first;  // disarmed by a fault of the board, or by a device that is back
  set("action", held && !silent ? "Fault" : silent ? (frame.silent_s === null ? "No data yet" : "No data") : ACTIONS[frame.action] || frame.action || "–");
  set("mode", silent ? "–" : MODES[frame.mode] || frame.mode || "–");
  const force = silent || frame.force_N === null ? "–" : `${frame.force_N.toFixed(3)} N`;
  set("force", force);
  const first = frame.first;
  const story = first && [first.says, first.remedy, ...(first.followed.length ? ["Then:", ...first.followed] : [])].join("\n");
  const said = story || frame.causes.map(cause => `${cause[0].toUpperCase()}${cause.slice(1)}.`).join("\n") || IDLE[frame.mode] || "No safety cause is active.";
  set("cause", !silent ? said : frame.silent_s === null ? "No message of the rig yet. Check that it runs, with the endpoints of this rig file."
    : `No message of the rig for ${frame.silent_s.toFixed(0)} s. The values shown are old.`);
}

export function showLoop(loop, frame) {
  if (!loop) return fill(element("loop"), [["", "no data yet"]]);
  const virtual = loop.lateness_p99_us === null || loop.lateness_p99_us === undefined;
  const rows = [
    ["rate", `${loop.loop_hz.toFixed(0)} Hz`], ["missed ticks", ...count(loop.missed_ticks)],
    ["tick 50 / 99 %", `${us(loop.tick_p50_us)} / ${us(loop.tick_p99_us)}`],
    ["tick 99.9 % / longest", `${us(loop.tick_p999_us)} / ${us(loop.tick_max_us)}`]];
  if (virtual) rows.push(["lateness", "virtual time"]);
  else rows.push(["lateness 50 / 99 %", `${us(loop.lateness_p50_us)} / ${us(loop.lateness_p99_us)}`],
    ["lateness 99.9 % / longest", `${us(loop.lateness_p999_us)} / ${us(loop.lateness_max_us)}`]);
  rows.push(["longest gap", loop.longest_gap_ms ? `${loop.longest_gap_ms.toFixed(1)} ms` : "–"],
    ["pose age", frame.pose_age_ms === null ? "–" : `${frame.pose_age_ms.toFixed(0)} ms`],
    ["refused poses, forces", `${whole(frame.rejected[0])}, ${whole(frame.rejected[1])}`]);
  fill(element("loop"), rows);
}

export function showModel(model) {
  if (!model) return fill(element("model"), [["", "no data yet"]]);
  const known = value => value !== null && value !== undefined;
  const rows = [];
  if (known(model.scale)) {
    rows.push(["stiffness relative to the file", `${(100 * model.scale).toFixed(1)} ± ${(100 * model.sd).toFixed(1)} %`],
      ["adaptation", model.adaptation + (model.text ? `: ${model.text}` : ""), model.adaptation === "limited" ? "bad" : ""]);
  }
  if (known(model.place)) {
    const where = known(model.body_offset_m) ? `, ${(1000 * model.body_offset_m).toFixed(0)} ± ${(1000 * model.body_offset_sd_m).toFixed(0)} mm behind the tip` : "";
    const away = model.place !== "tip", by = known(model.sensors) ? ` (${model.sensors} sensors)` : "";
    rows.push(["contact away from the tip", (away ? `${model.place}${where}` : "none") + by, away ? "bad" : ""]);
    if (away && model.contact_text) rows.push(["", model.contact_text]);
  }
  fill(element("model"), rows);
}

export function showBoard(board) {
  if (!board) return fill(element("board"), [["", "no data yet"]]);
  const fault = board.fault ? board.fault_name || `fault ${board.fault}` : "none";
  fill(element("board"), [
    ["state", board.state, board.state === "fault" ? "bad" : ""], ["fault", fault, board.fault ? "bad" : "good"],
    ["last status", `${board.age_ms.toFixed(0)} ms ago`, board.age_ms > 500 ? "bad" : ""],
    ["set-points in the queue", whole(board.queue_depth)],
    ["since the last set-point", `${board.deadman_age_ms.toFixed(0)} ms`],
    ["queue underruns", ...count(board.underruns)],
    ["damaged frames", ...count(board.crc_errors + (board.host_crc_errors || 0))],
    ["refused set-points", `${whole(board.rejected)}${board.last_reject ? ` (${board.last_reject})` : ""}`, board.rejected ? "bad" : ""],
    ["starts of the board", whole(board.boot_count)]]);
}

export function showLog(lines, origin) {
  const list = element("log");
  list.replaceChildren(...(lines.length ? [...lines].reverse() : [null]).map(line => {
    const item = document.createElement("li");
    if (!line) { item.textContent = "no lines yet"; item.className = "muted"; return item; }
    const time = document.createElement("time");
    time.textContent = `${(line.t - origin).toFixed(1)} s`;
    const text = document.createElement("span");
    text.className = line.level;
    text.textContent = `${line.source}: ${line.text}`;
    item.append(time, text);
    return item;
  }));
}
