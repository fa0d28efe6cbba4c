"""Studies: computations behind the daemon's rules. Nothing of the daemon imports them; ``graderd[study]`` installs what
they need."""
