"""Posed pictures of structure-from-motion programs as panoramas: nerfstudio, COLMAP, openMVG, OpenSfM, Metashape.

Each format has a module that reads its file; `shots` makes panoramas of the pictures.
"""
