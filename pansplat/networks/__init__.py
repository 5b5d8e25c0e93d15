"""Networks that are not the paper's: depth of panoramas, and the matcher of photographs (ALIKED, LightGlue)."""
