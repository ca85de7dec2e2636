"""The fault campaign: faults in every phase on the simulated rig, detection and peak force."""
