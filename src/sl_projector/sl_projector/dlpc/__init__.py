"""The DMD controllers DLPC900 and DLPC350: models, protocols, image codecs and drivers."""
