"""The rig's processes as services: unit files, their installation, a supervisor with the same contract."""
