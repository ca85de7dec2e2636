"""The control study: force and position figures of each law on the simulated rig."""
