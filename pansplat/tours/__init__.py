"""Tours: many panoramas of one place as a graph, the scenes of its edges, routes along it, and its floor plan.

An edge joins two panoramas that show the same surfaces. A camera flies along edges; the scene of an edge is predicted
from its two panoramas and a third one that overlaps with both. Panoramas without poses are parts of their own, with a
self-edge and the scene of a single view. Between parts the camera zooms, from photograph to photograph.
"""
