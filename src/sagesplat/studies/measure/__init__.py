"""How close levels of detail are to their scene, whoever made them."""
