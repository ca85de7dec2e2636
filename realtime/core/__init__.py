"""What arrives becomes records, the tick runs, frames and messages leave: the same on both clocks."""
