"""What identification is compared with: ARX, OE, ARMAX."""
