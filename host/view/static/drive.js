// The drive panel: hold a button to jog, go to a typed point, touch, change the force, zero the sensor, note a moment.

const REPEAT_MS = 100;
const AXES = {e1: [1, 0, 0], e2: [0, 1, 0], e3: [0, 0, 1]};
const KEYS = {ArrowRight: "+e1", ArrowLeft: "-e1", ArrowUp: "+e2", ArrowDown: "-e2", PageUp: "+e3", PageDown: "-e3"};

export class Drive {
  // controls: sends presses and shows answers (controls.js).
  constructor(holder, controls) {
    this.holder = holder;
    this.controls = controls;
    this.held = null;
    for (const button of holder.querySelectorAll("[data-jog]")) this.#jogButton(button);
    for (const button of holder.querySelectorAll("[data-do]"))
      button.addEventListener("click", () => controls.confirmed(button, button.dataset.do, () => this.#fields(button.dataset.do)));
    this.homes = [];
    for (const button of holder.querySelectorAll("[data-home]"))
      button.addEventListener("click", () => controls.confirmed(button, "home", () => ({axis: button.dataset.home})));
    holder.querySelector("#mark").addEventListener("submit", event => { event.preventDefault(); this.#mark(); });
    document.addEventListener("keydown", event => this.#key(event, true));
    document.addEventListener("keyup", event => this.#key(event, false));
    for (const lost of ["blur", "pagehide"]) window.addEventListener(lost, () => this.release());
    document.addEventListener("visibilitychange", () => { if (document.hidden) this.release(); });
  }

  // Only axes with a home switch in the rig file have a button.
  begin(hello) {
    this.homes = [...this.holder.querySelectorAll("[data-home]")].filter(button => {
      button.hidden = !hello.homes.includes(button.dataset.home);
      return !button.hidden;
    });
    this.holder.querySelector("#homes").hidden = !this.homes.length;
    this.holder.querySelector("#homes-note").textContent = this.homes.length ? "Home moves an axis of the disarmed rig to its switch."
      : "No axis has a home switch (home_end in the rig file).";
  }

  // An axis is homed while the rig is disarmed and shows fresh data.
  show(frame) {
    const may = frame.mode === "disarmed" && frame.silent_s !== null && frame.silent_s <= 1;
    for (const button of this.homes) if (button.disabled === may) {
      button.disabled = !may;
      button.title = may ? "" : "Disarm the rig first";
    }
  }

  #jogButton(button) {
    const release = () => this.release();
    button.addEventListener("pointerdown", event => {
      if (event.button) return;
      button.setPointerCapture(event.pointerId);
      this.#hold(button);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture", "blur"]) button.addEventListener(end, release);
    button.addEventListener("contextmenu", event => event.preventDefault());
    button.addEventListener("keydown", event => {
      if ((event.key === " " || event.key === "Enter") && !event.repeat) { event.preventDefault(); this.#hold(button); }
    });
    button.addEventListener("keyup", event => { if (event.key === " " || event.key === "Enter") release(); });
  }

  // Arrow and page keys jog only while their box is ticked, and never while something is typed.
  #key(event, down) {
    const typing = /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName) && event.target.type !== "checkbox";
    if (event.key === "Escape" && down) return this.controls.stop();
    const way = KEYS[event.key];
    if (!way || typing || !this.holder.querySelector("#keys").checked || this.holder.hidden) return undefined;
    event.preventDefault();
    if (!down) return this.release();
    if (!event.repeat) this.#hold(this.holder.querySelector(`[data-jog="${way}"]`));
    return undefined;
  }

  #hold(button) {
    this.release();
    button.classList.add("held");
    const way = button.dataset.jog, axis = way.slice(1), sign = way[0] === "-" ? -1 : 1;
    const message = {button: "jog", axis: AXES[axis] ? "tip" : axis, forwards: sign > 0,
      share: Number(this.holder.querySelector("#pace").value)};
    if (AXES[axis]) message.direction = AXES[axis];
    const send = () => { if (!this.controls.send(message)) this.release(); };
    this.held = {button, timer: setInterval(send, REPEAT_MS)};
    this.controls.say(`Jog ${way}: moving while held.`, "");
    send();
  }

  // What ends a jog: the button, the focus, the page, or a refusal. Without any of these it ends with its last command.
  release(tell = true) {
    if (!this.held) return;
    clearInterval(this.held.timer);
    this.held.button.classList.remove("held");
    this.held = null;
    if (tell) this.controls.send({button: "hold", confirmed: true});
  }

  // A jog that was refused is not repeated; one that was accepted needs no line.
  answered(answer) {
    if (answer.action !== "jog") return false;
    if (answer.result === "accepted") return true;
    this.release(false);
    return false;
  }

  #numbers(ids) {
    return ids.map(id => {
      const input = this.holder.querySelector(`#${id}`), value = input.value.trim() === "" ? NaN : Number(input.value);
      input.classList.toggle("wrong", !Number.isFinite(value));
      return value;
    });
  }

  // The typed values of a command in SI; null where one is missing.
  #fields(name) {
    const place = this.#numbers(["x-mm", "y-mm", "z-mm"]).map(mm => mm / 1000), [force] = this.#numbers(["newton"]);
    const normal = this.#numbers(["n1", "n2", "n3"]), size = Math.hypot(...normal);
    const wanted = {goto: place, touch: [...place, force, size || NaN], force: [force]}[name] || [];
    if (!wanted.every(Number.isFinite)) {
      this.controls.say("A number is missing or not valid: see the marked fields.", "bad");
      return null;
    }
    if (name === "goto") return {point_m: place};
    if (name === "touch") return {point_m: place, normal: normal.map(part => part / size), force_N: force};
    return name === "force" ? {force_N: force} : {};
  }

  // Fill in a point that was picked in the scene; nothing moves before its button is confirmed.
  picked(found) {
    if (!found) return this.controls.say("The tissue is not known there. Type the point, or touch once.", "bad");
    const values = [...found.point.map(mm => mm.toFixed(1)), ...found.normal.map(part => String(Number(part.toFixed(4))))];
    ["x-mm", "y-mm", "z-mm", "n1", "n2", "n3"].forEach((id, index) => {
      this.holder.querySelector(`#${id}`).value = values[index];
    });
    this.controls.say(`Picked ${values.slice(0, 3).join(", ")} mm. Go to or Touch, twice, moves there.`, "");
    return undefined;
  }

  #mark() {
    const note = this.holder.querySelector("#note");
    if (!note.value.trim()) return this.controls.say("Mark: the note is empty.", "bad");
    this.controls.send({button: "mark", note: note.value.trim()});
    note.value = "";
    return undefined;
  }
}
