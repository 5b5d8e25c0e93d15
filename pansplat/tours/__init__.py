"""Tours: many panoramas of one place as a graph, the scenes of its edges, routes along it, and its floor plan.

An edge joins two panoramas that show the same surfaces. `default` predicts a part at once; the scene of an edge is the
Gaussians of its two panoramas and of a third one that overlaps with both. Panoramas without poses are parts of their
own, with a self-edge. A camera flies along edges, and zooms along poor edges and between parts.
"""
