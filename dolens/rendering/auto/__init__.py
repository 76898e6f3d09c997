"""The choice among renderers: the cheapest model that stays within a stated error."""
