"""The control tick and its blocks: pure functions of parameters, state and inputs, compiled."""
