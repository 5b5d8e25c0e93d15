"""Files made of scenes and tours: web pages, floor plans, meshes, training sets, and the clean-up before."""
