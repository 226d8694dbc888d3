"""`flexlink study`: many controllers for one identified plant, compared by their certificates."""
