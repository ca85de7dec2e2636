"""Processes and jobs on a rig: the demo, the model process, a commander, the services' units."""
