// The buttons. Stop acts at once; every other asks for a second press within a few seconds. The answer is shown.

const ASKS_MS = 4000;
const NAMES = {arm: "Arm", hold: "Hold", stop: "Stop", disarm: "Disarm", clear: "Clear fault", goto: "Go to", touch: "Touch",
  force: "Set force", retract: "Retract", zero: "Zero force", home: "Home", jog: "Jog", mark: "Mark"};

export class Controls {
  constructor(holder, send) {
    this.answer = holder.querySelector("#answer");
    this.idle = this.answer.textContent;
    this.send = send;
    for (const button of holder.querySelectorAll("[data-button]")) {
      const name = button.dataset.button;
      button.addEventListener("click", () => name === "stop" ? this.stop() : this.confirmed(button, name));
    }
  }

  stop() {
    this.#ask("stop", {});
  }

  // Ask for a second press of `button`, then send; `fields` gives what goes with it, null for nothing to send.
  confirmed(button, name, fields = () => ({})) {
    if (!button.classList.contains("asks")) {
      if (fields() === null) return;
      button.classList.add("asks");
      button.label = button.textContent;
      button.textContent = `Confirm ${button.label.toLowerCase()}`;
      const question = `${button.label}: press again to confirm.`;
      this.say(question, "");
      button.timer = setTimeout(() => {
        this.#calm(button);
        if (this.answer.textContent === question) this.say(`${button.label}: not confirmed, nothing was sent.`, "");
      }, ASKS_MS);
      return;
    }
    this.#calm(button);
    const values = fields();
    if (values !== null) this.#ask(name, values);
  }

  #calm(button) {
    clearTimeout(button.timer);
    button.classList.remove("asks");
    button.textContent = button.label;
  }

  #ask(name, fields) {
    const sent = this.send({button: name, confirmed: true, ...fields});
    this.waiting = sent ? NAMES[name] : "";
    this.say(sent ? `${NAMES[name]}: sent, waiting for the answer.` : `${NAMES[name]}: not sent, the page has lost its server.`, sent ? "" : "bad");
  }

  // The connection is gone: what was sent and not answered has no answer any more.
  lost() {
    if (this.waiting) this.say(`${this.waiting}: no answer, the page has lost its server. It may or may not have been carried out.`, "bad");
    this.waiting = "";
  }

  answered(answer) {
    this.waiting = "";
    const name = NAMES[answer.action] || "Command";
    this.say(`${name}: ${answer.result}${answer.text ? `. ${answer.text}` : "."}`, answer.result === "accepted" ? "accepted" : "bad");
  }

  say(text, result) {
    this.answer.textContent = text;
    this.answer.dataset.result = result;
  }
}
