"""A small suite of cheap concealed cases and finders that cheat, for tests of the proof itself."""

import hashlib
import json
import sys
from pathlib import Path

from sim.concealed import suite as concealed
from sim.concealed.suite import ConcealedPlan

SEED = 77
DRAFTS = (
    ("null", "axis", 0.0),
    ("null", "impedance", 0.0),
    ("null", "transmission", 0.0),
    ("single", "axis", 1.0),
    ("single", "transmission", 0.5),
    ("single", "impedance", 0.25),
    ("single", "transmission", 0.1),
    ("pair", "transmission", 1.0),
    ("outside", "axis", 1.0),
    ("outside", "transmission", 2.0),
)


def build(folder: Path) -> list[dict]:  # type: ignore[type-arg]
    """Cases and seal as the generator leaves them, without its costly kinds. Returns the labels."""
    plans = [ConcealedPlan(SEED, i, category, kind, i % 2 == 0, rho, i) for i, (category, kind, rho) in enumerate(DRAFTS)]
    folder = folder / "own"
    labels = [concealed.make(plan, folder / "cases" / plan.id) for plan in plans]
    (folder / "sealed").mkdir()
    content = json.dumps({"seed": SEED, "cases": len(plans), "labels": labels}, sort_keys=True)
    (folder / "sealed" / "labels.json").write_text(content)
    return labels


def finder(path: Path, body: str) -> str:
    """A program that is called as `seldinger diagnose` is and prints the verdict that `body` makes as `verdict`."""
    path.write_text(
        "import hashlib, json, os, sys, time\n"
        "recordings = sys.argv[1:sys.argv.index('--nominal')]\n"
        f"{body}\n"
        "print(json.dumps(verdict))\n"
    )
    return f"{sys.executable} {path}"


NOTHING = "verdict = {'verdict': 'nothing_missing', 'located': [], 'effects': [], 'fit': {}}"
BACKLASH = (
    "verdict = {'verdict': 'missing_physics', 'located': [], 'fit': {}, 'effects': [{'id': 'backlash', 'subsystem': 'roll',"
    " 'parameters': {}, 'indistinguishable_from': []}]}"
)


def truthful(path: Path, folder: Path, labels: list[dict]) -> str:  # type: ignore[type-arg]
    """A finder that was given the truth: it knows a case by the hash of its first recording."""
    answers = {}
    for label in labels:
        first = min((folder / "own" / "cases" / label["id"]).glob("a.*"))
        answers[hashlib.sha256(first.read_bytes()).hexdigest()] = answer(label)
    body = (
        f"known = json.loads({json.dumps(json.dumps(answers))})\n"
        "verdict = known[hashlib.sha256(open(recordings[0], 'rb').read()).hexdigest()]"
    )
    return finder(path, body)


def answer(label: dict) -> dict:  # type: ignore[type-arg]
    """The verdict that deserves full marks."""
    effects = []
    for planted, place in zip(label["planted"], [t.rpartition("@")[2] for t in label["truth"]], strict=True):
        values = {
            name: {
                "value": planted["parameters"][name],
                "ci95": sorted([0.9 * planted["parameters"][name], 1.1 * planted["parameters"][name]]),
            }
            for name in planted["compared"]
        }
        effects.append(
            {
                "id": planted["id"],
                "subsystem": place,
                "parameters": values,
                "indistinguishable_from": [],
                "equation": f"y = {label['form']}" if label["form"] else "",
            }
        )
    fit = {
        "per_channel": {
            c: {"rmse_before": (label["mismatch_rms_heldout"][c] ** 2 + noise**2) ** 0.5, "rmse_after": noise}
            for c, noise in label["noise_rms_heldout"].items()
        }
    }
    kind = "missing_physics" if effects else "nothing_missing"
    located = [
        {"subsystem": e["subsystem"], "channels": label["channels"], "windows_s": label["windows_s"]} for e in effects
    ]
    return {"verdict": kind, "effects": effects, "located": located, "fit": fit}
