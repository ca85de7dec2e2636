"""The mismatch finder: where simulation and recording part, what physics was left out, its model and the proof."""
