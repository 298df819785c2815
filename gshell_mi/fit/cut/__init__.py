"""From a moved template to fields: how it is cut, and what of it nobody sees."""
