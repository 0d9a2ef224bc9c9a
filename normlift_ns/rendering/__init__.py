"""normlift_ns.rendering"""
