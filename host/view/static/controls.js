// The buttons. Stop acts at once; every other asks for a second press within a few seconds. The answer is shown.

const ASKS_MS = 4000;
const QUESTIONS = {arm: "Confirm arm", hold: "Confirm hold", disarm: "Confirm disarm", clear: "Confirm clear"};
const NAMES = {arm: "Arm", hold: "Hold", stop: "Stop", disarm: "Disarm", clear: "Clear fault"};

export class Controls {
  constructor(holder, send) {
    this.answer = holder.querySelector("#answer");
    this.send = send;
    for (const button of holder.querySelectorAll("[data-button]")) button.addEventListener("click", () => this.#press(button));
  }

  #press(button) {
    const name = button.dataset.button;
    if (name === "stop") return this.#ask(name, button);
    if (!button.classList.contains("asks")) {
      button.classList.add("asks");
      button.textContent = QUESTIONS[name];
      this.#say(`${NAMES[name]}: press again to confirm.`, "");
      button.timer = setTimeout(() => this.#calm(button), ASKS_MS);
      return undefined;
    }
    this.#calm(button);
    return this.#ask(name, button);
  }

  #calm(button) {
    clearTimeout(button.timer);
    button.classList.remove("asks");
    button.textContent = NAMES[button.dataset.button];
  }

  #ask(name) {
    const sent = this.send({button: name, confirmed: true});
    this.#say(sent ? `${NAMES[name]}: sent, waiting for the answer.` : `${NAMES[name]}: not sent, the page has lost its server.`, sent ? "" : "bad");
  }

  answered(answer) {
    const name = NAMES[answer.action] || "Command";
    this.#say(`${name}: ${answer.result}${answer.text ? `. ${answer.text}` : "."}`, answer.result === "accepted" ? "accepted" : "bad");
  }

  #say(text, result) {
    this.answer.textContent = text;
    this.answer.dataset.result = result;
  }
}
