"""The progress of a diagnosis: one share that never falls, steps that are counted."""

from __future__ import annotations

from host.diagnosis.model.progress import Overall


def test_the_share_never_falls_and_steps_are_counted() -> None:
    seen: list[tuple[str, float]] = []
    overall = Overall(lambda what, share: seen.append((what, share)))
    overall.part(0.0, 0.05)("reading", 0.0)
    search = overall.part(0.05, 0.8)
    for step in range(6):
        for k in range(4):
            search(f"screening {step}", k / 4)
    overall.part(0.8, 1.0)("intervals", 0.0)
    overall.end()
    shares = [share for _, share in seen]
    assert shares == sorted(shares) and shares[-1] == 1.0 and max(shares[:-1]) <= 0.8
    assert seen[1][0] == "step 2: screening 0" and seen[-1][0] == "step 8: done"
    assert len(set(shares[1:25])) == 24  # every call within a step moves it on
