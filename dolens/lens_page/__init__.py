"""The page of a lens: what a designer looks at, in one HTML file or in a terminal."""
