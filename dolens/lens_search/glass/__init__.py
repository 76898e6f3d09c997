"""Glass is a variable of a search: continuous at first, a catalogue's in the end."""
