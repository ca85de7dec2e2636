"""Static models of the catheter: planar arcs, spatial rod, and the parameters they share."""
