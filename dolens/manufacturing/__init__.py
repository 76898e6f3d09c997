"""A designed lens becomes what a workshop asks for: solids in a STEP file, and drawings."""
