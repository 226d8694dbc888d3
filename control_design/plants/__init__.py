"""The uncertain plant: ellipses, plant sets, weights, frequency grid."""
