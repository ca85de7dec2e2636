// The buttons. Stop acts at once; every other asks for a second press within a few seconds. The answer is shown.

const ASKS_MS = 4000;
const NAMES = {arm: "Arm", hold: "Hold", stop: "Stop", disarm: "Disarm", clear: "Clear fault", goto: "Go to", touch: "Touch",
  force: "Set force", retract: "Retract", zero: "Zero force", jog: "Jog", mark: "Mark"};

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
      button.textContent = `Confirm ${NAMES[name].toLowerCase()}`;
      const question = `${NAMES[name]}: press again to confirm.`;
      this.say(question, "");
      button.timer = setTimeout(() => {
        this.#calm(button, name);
        if (this.answer.textContent === question) this.say(`${NAMES[name]}: not confirmed, nothing was sent.`, "");
      }, ASKS_MS);
      return;
    }
    this.#calm(button, name);
    const values = fields();
    if (values !== null) this.#ask(name, values);
  }

  #calm(button, name) {
    clearTimeout(button.timer);
    button.classList.remove("asks");
    button.textContent = NAMES[name];
  }

  #ask(name, fields) {
    const sent = this.send({button: name, confirmed: true, ...fields});
    this.say(sent ? `${NAMES[name]}: sent, waiting for the answer.` : `${NAMES[name]}: not sent, the page has lost its server.`, sent ? "" : "bad");
  }

  answered(answer) {
    const name = NAMES[answer.action] || "Command";
    this.say(`${name}: ${answer.result}${answer.text ? `. ${answer.text}` : "."}`, answer.result === "accepted" ? "accepted" : "bad");
  }

  say(text, result) {
    this.answer.textContent = text;
    this.answer.dataset.result = result;
  }
}
