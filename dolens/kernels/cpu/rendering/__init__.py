"""The renderer and the splat on the CPU: sampling, lookup, and the drivers around the trace."""
