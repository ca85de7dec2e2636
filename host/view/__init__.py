"""The rig on a page: what a browser gets thirty times a second, live or from a recording, and who may read it."""
