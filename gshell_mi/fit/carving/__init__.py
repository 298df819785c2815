"""Where the surface is deeper than it was, as in hollows, vessels and recesses, or less deep, as in dents."""
