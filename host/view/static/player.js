// The player of a recording: play, pause, seek, speed, and the windows of its diagnosis on the time line.

const element = id => document.getElementById(id);

export class Player {
  constructor(hello, send) {
    Object.assign(this, {hello, send, playing: true, held: false});
    const seek = element("seek");
    seek.max = hello.end - hello.begin;
    seek.addEventListener("pointerdown", () => { this.held = true; });
    seek.addEventListener("pointerup", () => { this.held = false; });
    seek.addEventListener("input", () => send({seek_s: hello.begin + Number(seek.value)}));
    element("play").addEventListener("click", () => send({play: !this.playing}));
    element("speed").addEventListener("change", event => send({speed: Number(event.target.value)}));
    element("player").hidden = false;
    this.#windows();
    this.#findings();
  }

  #windows() {
    const {begin, end, windows} = this.hello, span = Math.max(end - begin, 1e-9);
    element("windows").hidden = windows.length === 0;
    element("windows").replaceChildren(...windows.map(window => {
      const mark = document.createElement("i");
      mark.style.left = `${100 * (window.from - begin) / span}%`;
      mark.style.width = `${100 * (window.to - window.from) / span}%`;
      mark.title = `${window.subsystem}: ${window.condition}`;
      return mark;
    }));
  }

  #findings() {
    const {begin, windows, verdict, says} = this.hello;
    element("findings-card").hidden = !verdict;
    element("verdict").textContent = verdict.replaceAll("_", " ");
    const spans = new Map();
    for (const window of windows) {
      const what = `${window.subsystem}: ${window.condition}`;
      spans.set(what, [...(spans.get(what) || []), `${(window.from - begin).toFixed(1)}–${(window.to - begin).toFixed(1)} s`]);
    }
    const rows = [...says, ...[...spans].map(([what, times]) => {
      const shown = times.slice(0, 8).join(", ");
      return `${what} (${shown}${times.length > 8 ? `, and ${times.length - 8} more` : ""})`;
    })];
    element("findings").replaceChildren(...rows.map(text => {
      const item = document.createElement("li");
      item.textContent = text;
      return item;
    }));
  }

  show(play) {
    this.playing = play.playing;
    const at = play.at - this.hello.begin, total = this.hello.end - this.hello.begin;
    element("play").textContent = play.playing ? "Pause" : at >= total - 1e-3 ? "Again" : "Play";
    element("clock").textContent = `${at.toFixed(1)} of ${total.toFixed(1)} s`;
    if (!this.held) element("seek").value = at;
    const speed = element("speed"), wanted = [...speed.options].find(option => Number(option.value) === play.speed);
    if (wanted && document.activeElement !== speed) speed.value = wanted.value;
  }
}
