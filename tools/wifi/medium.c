/* The air between mac80211_hwsim radios: who hears whom, loss, airtime, carrier sense, collisions, retries.
 * medium LINKS STATS [SEED]: LINKS has lines "A B LOSS" (radio numbers, both ways, 0..1); read again on SIGHUP.
 * Totals go to STATS as JSON every second. Beacons of the ad-hoc network itself take no airtime here
 * (hwsim lets every station beacon in each interval; a real IBSS shares that). 2.4 GHz, rates without HT. */
#define _GNU_SOURCE
#include <errno.h>
#include <linux/genetlink.h>
#include <linux/netlink.h>
#include <poll.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>
enum { C_REGISTER = 1, C_FRAME = 2, C_TXINFO = 3 };
enum { A_RECEIVER = 1, A_TRANSMITTER, A_FRAME, A_FLAGS, A_RX_RATE, A_SIGNAL, A_TX_INFO, A_COOKIE, A_FREQ = 19 };
#define N 64
#define QUEUE 256
#define US(x) ((int64_t)(x))
typedef struct { uint8_t data[2600]; int len; uint32_t flags; uint64_t cookie; int8_t rate[4]; uint8_t count[4];
                 uint32_t freq; uint8_t out[8]; } frame;
typedef struct { frame *q[QUEUE]; int head, n; int64_t start_at, end; int tx, attempt, ri, rc; double cw; } station;
static station st[N];
static float loss[N][N]; static uint8_t hears[N][N];
static struct { int s; int64_t from, to; } past[512]; static int npast;
static struct { uint64_t bc, bc_us, bc_bytes, uni, uni_us, uni_bytes, uni_failed, retries, collided, lost, heard, mgmt, mgmt_us, nulls, full; } t;
static int fd, family; static volatile int again = 1; static const char *links;
static const double mbit[12] = {1, 2, 5.5, 11, 6, 9, 12, 18, 24, 36, 48, 54};
static int64_t now(void) { struct timespec s; clock_gettime(CLOCK_MONOTONIC, &s); return s.tv_sec * 1000000LL + s.tv_nsec / 1000; }
static double rnd(void) { return drand48(); }
static void hup(int s) { (void)s; again = 1; }
static void readlinks(void) {
  FILE *f = fopen(links, "r"); char l[100]; int a, b; float p; again = 0;
  memset(hears, 0, sizeof hears);
  if (!f) return;
  while (fgets(l, sizeof l, f)) if (sscanf(l, "%d %d %f", &a, &b, &p) == 3 && a < N && b < N) {
    hears[a][b] = hears[b][a] = 1; loss[a][b] = loss[b][a] = p; }
  fclose(f);
}
static char buf[65536];
typedef struct { struct nlmsghdr h; struct genlmsghdr g; char rest[4000]; } msg;
static void put(msg *m, int type, const void *d, int len) {
  struct nlattr *a = (void *)((char *)m + NLMSG_ALIGN(m->h.nlmsg_len));
  a->nla_type = type; a->nla_len = NLA_HDRLEN + len; memcpy((char *)a + NLA_HDRLEN, d, len);
  m->h.nlmsg_len = NLMSG_ALIGN(m->h.nlmsg_len) + NLA_ALIGN(a->nla_len);
}
static void begin(msg *m, int fam, int cmd) {
  memset(m, 0, sizeof(m->h) + sizeof(m->g)); m->h.nlmsg_len = NLMSG_LENGTH(GENL_HDRLEN); m->h.nlmsg_type = fam;
  m->h.nlmsg_flags = NLM_F_REQUEST; m->g.cmd = cmd; m->g.version = 1;
}
static void sendm(msg *m) { if (send(fd, m, m->h.nlmsg_len, 0) < 0) perror("send"); }
static void addr(uint8_t *a, int s) { memset(a, 0, 6); a[0] = 0x42; a[3] = s >> 8; a[4] = s; }
static void deliver(frame *f, int to, int rate) {
  msg m; uint8_t a[6]; uint32_t r = rate < 0 ? 0 : rate, sig = (uint32_t)-50; addr(a, to); begin(&m, family, C_FRAME);
  put(&m, A_RECEIVER, a, 6); put(&m, A_FRAME, f->data, f->len); put(&m, A_RX_RATE, &r, 4); put(&m, A_SIGNAL, &sig, 4);
  if (f->freq) put(&m, A_FREQ, &f->freq, 4);
  sendm(&m);
}
static void report(frame *f, int s, int ok) {
  msg m; uint8_t a[6]; uint32_t fl = f->flags | (ok ? 4 : 0), sig = (uint32_t)-50; addr(a, s); begin(&m, family, C_TXINFO);
  put(&m, A_TRANSMITTER, a, 6); put(&m, A_FLAGS, &fl, 4); put(&m, A_COOKIE, &f->cookie, 8); put(&m, A_SIGNAL, &sig, 4);
  put(&m, A_TX_INFO, f->out, 8); sendm(&m);
}
static int64_t airtime(int len, int rate) {
  double r = mbit[rate < 0 || rate > 11 ? 0 : rate]; int bits = (len + 4) * 8;
  return rate >= 4 ? 20 + 4 * (int64_t)((22 + bits) / (r * 4) + 1) : 192 + (int64_t)(bits / r);
}
static int64_t sensed(int s) { int64_t e = 0; for (int i = 0; i < N; i++) if (st[i].tx && (hears[i][s] || i == s) && st[i].end > e) e = st[i].end; return e; }
static void contend(int s) {
  int64_t n = now(), e = sensed(s);
  st[s].start_at = (e > n ? e : n) + 50 + 20 * (int64_t)(rnd() * st[s].cw);
}
static int clean(int r, int s, int64_t from, int64_t to) {
  for (int i = 0; i < npast; i++) if (past[i].s != s && past[i].from < to && past[i].to > from &&
      (past[i].s == r || hears[past[i].s][r])) return 0;
  return 1;
}
static void finish(int s) {
  station *x = &st[s]; frame *f = x->q[x->head]; int uni = !(f->data[4] & 1), rate = f->rate[x->ri], dst = -1, ok = 0;
  int64_t from = x->end - airtime(f->len, rate); x->tx = 0;
  if (uni) dst = f->data[7] << 8 | f->data[8];
  for (int r = 0; r < N; r++) if (r != s && hears[s][r] && (!uni || r == dst)) {
    if (!clean(r, s, from, x->end)) { t.collided++; continue; }
    if (rnd() < loss[s][r]) { t.lost++; continue; }
    t.heard++; ok = 1; deliver(f, r, rate);
  }
  f->out[2 * x->ri] = rate; f->out[2 * x->ri + 1] = x->rc + 1;
  if (uni && !ok) {   /* no ACK (an ACK itself is never lost here) */
    if (++x->rc >= f->count[x->ri]) { x->rc = 0; x->ri++; }
    if (x->ri < 4 && f->rate[x->ri] >= 0) { t.retries++; x->cw = x->cw * 2 > 1023 ? 1023 : x->cw * 2; contend(s); return; }
    t.uni_failed++;
  }
  report(f, s, uni ? ok : 0); free(f); x->head = (x->head + 1) % QUEUE; x->n--; x->cw = 31; x->ri = x->rc = 0;
  if (x->n) contend(s);
}
static void start(int s) {
  station *x = &st[s]; frame *f = x->q[x->head]; int64_t n = now();
  if (sensed(s) > n) { contend(s); return; }
  int64_t d = airtime(f->len, f->rate[x->ri]); int uni = !(f->data[4] & 1), type = f->data[0] >> 2 & 3;
  x->tx = 1; x->end = n + d;
  if (type != 2) { t.mgmt++; t.mgmt_us += d; }
  else if (uni) { t.uni++; t.uni_us += d + 10 + 304; t.uni_bytes += f->len; if (f->data[0] & 0x40) t.nulls++; }
  else { t.bc++; t.bc_us += d; t.bc_bytes += f->len; }
  past[npast % 512].s = s; past[npast % 512].from = n; past[npast % 512].to = x->end; npast++;
  if (npast >= 512) { int k = 0; for (int i = 0; i < 512; i++) if (past[i].to > n - 50000) past[k++] = past[i]; npast = k; }
}
static void incoming(struct nlmsghdr *h) {
  struct nlattr *a = (void *)((char *)NLMSG_DATA(h) + GENL_HDRLEN); int left = h->nlmsg_len - NLMSG_LENGTH(GENL_HDRLEN), s = -1;
  frame *f = calloc(1, sizeof *f); memset(f->rate, -1, 4); memset(f->out, 0xff, 8);
  for (; left >= NLA_HDRLEN && a->nla_len >= NLA_HDRLEN; left -= NLA_ALIGN(a->nla_len), a = (void *)((char *)a + NLA_ALIGN(a->nla_len))) {
    uint8_t *d = (uint8_t *)a + NLA_HDRLEN; int len = a->nla_len - NLA_HDRLEN;
    switch (a->nla_type & NLA_TYPE_MASK) {
    case A_TRANSMITTER: s = d[3] << 8 | d[4]; break;
    case A_FRAME: f->len = len > 2600 ? 2600 : len; memcpy(f->data, d, f->len); break;
    case A_FLAGS: memcpy(&f->flags, d, 4); break;
    case A_COOKIE: memcpy(&f->cookie, d, 8); break;
    case A_FREQ: memcpy(&f->freq, d, 4); break;
    case A_TX_INFO: for (int i = 0; i < 4; i++) { f->rate[i] = d[2 * i]; f->count[i] = d[2 * i + 1]; } break;
    }
  }
  if (s < 0 || s >= N || f->len < 24) { free(f); return; }
  if (f->rate[0] < 0) { f->rate[0] = 0; f->count[0] = 1; }
  int sub = f->data[0] & 0xfc;
  if (sub == 0x80) { /* beacon: at once */
    for (int r = 0; r < N; r++) if (r != s && hears[s][r] && rnd() >= loss[s][r]) deliver(f, r, 0);
    f->out[0] = 0; f->out[1] = 1; report(f, s, 0); free(f); return; }
  if (st[s].n >= QUEUE) { t.full++; f->out[0] = 0; f->out[1] = 1; report(f, s, 0); free(f); return; }
  st[s].q[(st[s].head + st[s].n++) % QUEUE] = f;
  if (st[s].n == 1) { st[s].cw = 31; st[s].ri = st[s].rc = 0; contend(s); }
}
static int resolve(void) {
  msg m; const char name[] = "MAC80211_HWSIM"; begin(&m, GENL_ID_CTRL, CTRL_CMD_GETFAMILY); put(&m, CTRL_ATTR_FAMILY_NAME, name, sizeof name); sendm(&m);
  int n = recv(fd, buf, sizeof buf, 0); struct nlmsghdr *h = (void *)buf; if (n < 0 || h->nlmsg_type == NLMSG_ERROR) return -1;
  struct nlattr *a = (void *)((char *)NLMSG_DATA(h) + GENL_HDRLEN); int left = h->nlmsg_len - NLMSG_LENGTH(GENL_HDRLEN);
  for (; left >= NLA_HDRLEN; left -= NLA_ALIGN(a->nla_len), a = (void *)((char *)a + NLA_ALIGN(a->nla_len)))
    if (a->nla_type == CTRL_ATTR_FAMILY_ID) return *(uint16_t *)((char *)a + NLA_HDRLEN);
  return -1;
}
static void stats(const char *path) {
  char tmp[300]; snprintf(tmp, sizeof tmp, "%s.new", path); FILE *f = fopen(tmp, "w"); if (!f) return;
#define P(k) fprintf(f, "\"" #k "\": %llu, ", (unsigned long long)t.k)
  fputc('{', f); P(bc); P(bc_us); P(bc_bytes); P(uni); P(uni_us); P(uni_bytes); P(uni_failed); P(retries); P(collided); P(lost); P(heard); P(mgmt); P(mgmt_us); P(nulls);
  fprintf(f, "\"full\": %llu, \"us\": %lld}\n", (unsigned long long)t.full, (long long)now()); fclose(f); rename(tmp, path);
}
int main(int argc, char **argv) {
  if (argc < 3) return 2;
  links = argv[1]; signal(SIGHUP, hup); srand48(argc > 3 ? atol(argv[3]) : time(0));
  fd = socket(AF_NETLINK, SOCK_RAW, NETLINK_GENERIC); struct sockaddr_nl me = {.nl_family = AF_NETLINK}; int big = 4 << 20;
  setsockopt(fd, SOL_SOCKET, SO_RCVBUFFORCE, &big, sizeof big);
  if (bind(fd, (void *)&me, sizeof me) || (family = resolve()) < 0) { perror("hwsim"); return 1; }
  msg m; begin(&m, family, C_REGISTER); m.h.nlmsg_flags |= NLM_F_ACK; sendm(&m);
  recv(fd, buf, sizeof buf, 0); struct nlmsghdr *h = (void *)buf;
  if (h->nlmsg_type == NLMSG_ERROR) { int e = ((struct nlmsgerr *)NLMSG_DATA(h))->error; if (e) { fprintf(stderr, "register: %s\n", strerror(-e)); return 1; } }
  fprintf(stderr, "medium: registered\n"); int64_t said = 0;
  for (;;) {
    if (again) readlinks();
    int64_t n = now(), next = n + 100000;
    for (int s = 0; s < N; s++) if (st[s].tx && st[s].end <= n) finish(s);
    for (int s = 0; s < N; s++) if (!st[s].tx && st[s].n && st[s].start_at <= n) start(s);
    for (int s = 0; s < N; s++) { if (st[s].tx && st[s].end < next) next = st[s].end; if (!st[s].tx && st[s].n && st[s].start_at < next) next = st[s].start_at; }
    if (n - said > 1000000) { said = n; stats(argv[2]); }
    n = now(); int64_t w = next > n ? next - n : 0; struct timespec ts = {w / 1000000, w % 1000000 * 1000}; struct pollfd p = {fd, POLLIN, 0};
    if (ppoll(&p, 1, &ts, NULL) > 0) for (int k = 0; k < 32; k++) {
      int len = recv(fd, buf, sizeof buf, MSG_DONTWAIT); if (len <= 0) break;
      for (struct nlmsghdr *g = (void *)buf; NLMSG_OK(g, (unsigned)len); g = NLMSG_NEXT(g, len)) {
        if (g->nlmsg_type == NLMSG_ERROR) continue;
        if (g->nlmsg_type == family && ((struct genlmsghdr *)NLMSG_DATA(g))->cmd == C_FRAME) incoming(g); }
    }
  }
}
