"""The running rig compared with its twin, window by window."""
