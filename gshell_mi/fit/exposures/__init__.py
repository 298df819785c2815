"""How views are exposed: what they see of the same places, and the gains that this tells."""
