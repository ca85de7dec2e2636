"""The rig on a page: what a browser is told thirty times a second, live or from a recording, and who may be told."""
