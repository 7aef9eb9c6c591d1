"""Models of every order from the compressed samples, and the choice among them."""
