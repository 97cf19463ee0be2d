#!/bin/bash
# A Linux guest with simulated Wi-Fi radios, for cells one after another. vm.sh build | run CELLS.json (to $WORK/share/results)
# Its clock advances by 1 ns an instruction and jumps over idle time, so the host's load changes no figure.
set -eu
HERE=$(cd "$(dirname "$0")" && pwd)
WORK=${WORK:-$PWD/rass-wifi}     # kernel, initramfs, share; an absolute path
PROJECT=${PROJECT:?the checkout of rass_mav, with its .venv}
MEM=${MEM:-3G}; LIMIT=${LIMIT:-3600}
mkdir -p "$WORK/share"
case ${1:-} in
build)
  # needs: qemu-system-x86 kmod cpio busybox-static gcc libc6-dev iw iproute2 batctl (apt-get install)
  cd "$WORK"
  pkg=$(apt-cache depends linux-image-amd64 | awk '/Depends/{print $2}')
  [ -d mod ] || { apt-get download "$pkg" && dpkg-deb -x linux-image-*.deb mod; }
  K=$(ls mod/lib/modules); depmod -b "$WORK/mod" "$K"
  rm -rf ird; mkdir -p ird/{bin,mod,proc,sys,dev,low,up,new,lib}
  cp /bin/busybox ird/bin/
  : > ird/mod/list
  for m in virtio_pci 9pnet_virtio 9p overlay; do
    modprobe -d "$WORK/mod" -S "$K" --show-depends $m | awk '/insmod/{print $2}'
  done | awk '!s[$0]++' | while read -r f; do cp "$f" ird/mod/; basename "$f" >> ird/mod/list; done
  cat > ird/init <<'INIT'
#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
for m in $(cat /mod/list); do insmod /mod/$m; done
mount -t 9p -o trans=virtio,version=9p2000.L,ro,cache=loose,msize=262144 root /low
mount -t tmpfs -o size=1G tmpfs /up; mkdir /up/u /up/w
mount -t overlay -o lowerdir=/low,upperdir=/up/u,workdir=/up/w overlay /new
mkdir -p /new/share /new/lib/modules
mount -t 9p -o trans=virtio,version=9p2000.L,cache=none,msize=262144 share /new/share
mount -t tmpfs tmpfs /new/run; mkdir -p /new/mnt; mount -t tmpfs tmpfs /new/mnt
mount --move /proc /new/proc; mount --move /sys /new/sys; mount --move /dev /new/dev
exec switch_root /new /share/guest-init
INIT
  chmod +x ird/init; (cd ird && find . | cpio -o -H newc --quiet | gzip -1 > ../initrd.gz)
  gcc -O2 -Wall -o medium "$HERE/medium.c" -lm
  ;;
run)
  cp "$2" "$WORK/share/cells.json"; cp "$HERE/lab.py" "$WORK/share/"; cd "$WORK"; rm -rf share/results; mkdir share/results
  cat > share/guest-init <<INIT
#!/bin/bash
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/ WORK=$WORK PROJECT=$PROJECT
ln -sfn $WORK/mod/lib/modules/\$(uname -r) /lib/modules/\$(uname -r)
mount -t debugfs d /sys/kernel/debug; mkdir -p /dev/shm; mount -t tmpfs t /dev/shm
sysctl -qw kernel.printk=3; ip link set lo up; ulimit -n 65536; cd /
$PROJECT/.venv/bin/python -P /share/lab.py /share/cells.json > /share/out 2>&1 < /dev/null
sync; echo o > /proc/sysrq-trigger; sleep 5
INIT
  chmod +x share/guest-init
  timeout "$LIMIT" nice -n "${NICE:-0}" qemu-system-x86_64 -accel tcg,tb-size=512 -cpu max -icount shift=0,sleep=off \
    -rtc base=2026-11-28T12:00:00,clock=vm -m "$MEM" -smp 1 -display none -nic none \
    -kernel mod/boot/vmlinuz-* -initrd initrd.gz -append "console=ttyS0 panic=-1 quiet" \
    -serial file:console.log -no-reboot \
    -virtfs local,path=/,mount_tag=root,security_model=none,readonly=on,multidevs=remap \
    -virtfs local,path="$WORK/share",mount_tag=share,security_model=none > qemu.log 2>&1 || true
  cat share/out
  ;;
*) sed -n 2p "$0"; exit 2 ;;
esac
