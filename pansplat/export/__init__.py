"""Files made of scenes and tours: web pages, floor plans, training sets, and the clean-up before."""
