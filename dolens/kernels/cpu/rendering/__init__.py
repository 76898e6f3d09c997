"""The renderer and the splat run on the CPU: sampling, lookup, and the drivers around the trace."""
