"""Roads out: the model and its pictures as other programs take them."""
